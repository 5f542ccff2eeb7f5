"""The built-in head model, built from formulas."""
