"""Image matching: features, candidate pairs, matches, verified links."""
