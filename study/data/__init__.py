"""From Episodes to frames: selection, store, data card and preview (Sec. IV-A, V)."""
