"""Bags: messages, and the packets in them."""
