"""Converters: recordings and scenarios of others, written as Episodes (docs/extend/convert.md)."""
