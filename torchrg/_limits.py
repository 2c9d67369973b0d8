"""Errors at limits of the system, which libraries raise in different ways."""

OUT_OF_MEMORY = "out of memory; use a machine with more memory, or a smaller part of the data."
"""Message of any out-of-memory error."""
_LIMITS = {
    "can't allocate memory": OUT_OF_MEMORY,
    "not enough memory": OUT_OF_MEMORY,
    "out of memory": OUT_OF_MEMORY,
    "failed to map segment": OUT_OF_MEMORY,
    "can't start new": "no further thread can be started; raise the limit of processes, or "
    "set OMP_NUM_THREADS=1.",
}
"""Messages by words in errors of Python, torch and the loader of libraries."""


def system_limit(error: BaseException) -> str:
    """Return the message of an error at a limit of the system, or "" for other errors."""
    if isinstance(error, MemoryError):
        return OUT_OF_MEMORY
    found = [message for words, message in _LIMITS.items() if words in str(error)]
    return found[0] if found and isinstance(error, RuntimeError | ImportError | SystemError) else ""
