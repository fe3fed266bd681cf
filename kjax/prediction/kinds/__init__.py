"""The kinds of prediction models that kjax has: each module holds ``KINDS``, records by name."""
