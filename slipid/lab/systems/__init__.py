"""Published systems that slipid is compared with: equations, sources, and deviations from them.

Their docstrings list under "Liberties" every deviation from the published form.
"""
