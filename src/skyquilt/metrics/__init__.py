"""Stage: figures that judge a result (part G of the methods)."""
