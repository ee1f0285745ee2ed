"""Inputs that nobody should trust: mutated seeds for everything that reads bytes or texts."""
