"""Heights on the map grid by the thesis's three routes."""
