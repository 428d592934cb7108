"""The edge of a fit: measured matrices read from files, what was found as JSON, text and figures.

The fit itself is ``service.fit``; nothing here decides anything about it.
"""
