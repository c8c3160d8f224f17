"""From a state to a list of contacts: candidates, geometry, reduction."""
