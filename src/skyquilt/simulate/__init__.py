"""A flight of known truth over procedural terrain. Imports no stage: an oracle shares no code with the judged."""
