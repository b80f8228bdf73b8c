"""Frames of a chess-board -> Camera [Yahyanejad 2013, 5.1, 6.3]."""
