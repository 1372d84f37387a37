"""Pure functions of the outcomes of a campaign."""
