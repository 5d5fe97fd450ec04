"""From Episodes to frames: bird views, head targets, selection, store and data card."""
