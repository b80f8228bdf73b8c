"""Ground heights and the orthomosaic that is drawn on them."""
