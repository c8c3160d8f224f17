"""Works for comparing programs: scenes as data, exact references, evaluation of results."""
