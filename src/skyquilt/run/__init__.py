"""How it runs: store, pixel cache, journal, executor."""
