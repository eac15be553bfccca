"""Objects of countable classes."""
