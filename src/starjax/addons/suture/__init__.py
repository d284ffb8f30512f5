"""Tasks of a needle in a tool with a wrist, through tissue and with a thread."""
