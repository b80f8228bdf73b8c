"""The thermal map on the visual map's grid."""
