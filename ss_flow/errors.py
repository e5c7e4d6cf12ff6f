"""The faults that a user or the machine has a part in; every other exception is a defect of ours."""


class InputError(Exception):
    """Bad usage or bad input: one sentence that names the thing, what is wrong and what would be right. Exit code 2."""


class ExecutorLost(RuntimeError):
    """Whoever runs the calls is gone, or must not run them, and the run ends; says why, and what to do."""


class OutputFailure(OSError):
    """What a user is to get cannot be written; says why, and what to do."""
