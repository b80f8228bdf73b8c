"""Pictures of different spectra laid on one another."""
