"""How good methods are, how fast, and where they fail; no other room imports this one."""
