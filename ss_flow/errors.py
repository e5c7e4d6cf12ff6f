"""The faults that a user can mend; every other exception is a defect of ours."""


class InputError(Exception):
    """Bad usage or bad input: one sentence that names the thing, what is wrong and what would be right. Exit code 2."""
