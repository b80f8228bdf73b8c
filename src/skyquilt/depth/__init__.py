"""Heights on the map grid by the three methods of the thesis."""
