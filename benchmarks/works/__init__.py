"""Works that programs are given to do: scenes as data, exact references, and how a result is judged."""
