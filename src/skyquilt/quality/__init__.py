"""How good a map is, in figures."""
