"""Stage: poses, surface and photos -> map pixels."""
