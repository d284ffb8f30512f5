"""Six successive transfers with two arms, an exercise of surgeons."""
