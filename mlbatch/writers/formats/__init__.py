"""One module per output format; each is found by its place here."""
