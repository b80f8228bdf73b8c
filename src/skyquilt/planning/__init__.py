"""Missions: from areas to picture-points, routes and files for ground stations, and back."""
