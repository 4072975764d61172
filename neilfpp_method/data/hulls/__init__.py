"""Shapes that silhouettes or points bound: where the geometry starts."""
