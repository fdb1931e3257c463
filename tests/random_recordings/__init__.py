"""Random recordings of ordinary behaviour, from a simulator of its own, and what must hold of every one of them."""
