"""``kjax <verb>``: one command for all that the package does from a shell."""
