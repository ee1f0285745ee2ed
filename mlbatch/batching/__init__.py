"""Windows of the common clock, and how columns are sorted into them."""
