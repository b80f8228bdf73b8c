"""How work runs: artefacts on disk, progress, threads, caches, the run's folder."""
