"""Bird views (Sec. III-A): a moment of an Episode as image and masks, and whole drives as pictures."""
