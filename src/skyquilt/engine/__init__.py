"""How work is executed: stored intermediate results, progress, threads, caches, the run folder."""
