"""What photos have in common: features, candidate pairs, matches, verified links."""
