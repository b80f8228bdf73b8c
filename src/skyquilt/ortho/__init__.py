"""Heights of the ground, and photos drawn on them: the orthomosaic."""
