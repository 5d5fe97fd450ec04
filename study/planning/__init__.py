"""What a sweep will run: its plan, the options that change it, and a look at it beforehand."""
