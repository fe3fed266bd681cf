"""Pictures and videos; the only part of kjax that imports matplotlib."""
