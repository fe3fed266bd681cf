"""The kinds of prediction models that kjax has: each ``ModelKind`` of a module, by its name."""
