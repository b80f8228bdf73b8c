"""The batch workflow: a folder of photos becomes a map."""
