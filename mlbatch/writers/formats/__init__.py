"""Output formats, one module each; `mlbatch.writers` finds them by their place here."""
