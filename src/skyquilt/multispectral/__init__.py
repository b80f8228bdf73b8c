"""All bands of a multispectral camera on the map's grid, and indices of vegetation."""
