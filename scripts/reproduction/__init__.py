"""Reproduction of the paper's tables and figures, and the report on its claims."""
