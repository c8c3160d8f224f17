"""Contacts to impulses: the frictional contact problem and its solvers."""
