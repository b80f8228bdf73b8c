"""Camera calibration from frames of a chess-board [Yahyanejad 2013, 5.1, 6.3]."""
