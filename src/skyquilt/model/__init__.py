"""The records: frozen dataclasses that flow from stage to stage. No input or output, no
algorithms.
"""
