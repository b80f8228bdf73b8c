"""Stage: two pictures of different spectra -> a registration, or a refusal with its reason."""
