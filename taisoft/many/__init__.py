"""Many runs, each in a process: the loop and the places that studies and `run_many` share, and `run_many` itself."""
