"""Measurements of this code base that do not belong to the package: whether results have changed, and speed."""
