"""Errors at limits of the system have one message, whichever library raises them."""

import pytest

from torchrg._limits import OUT_OF_MEMORY, system_limit


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
        ImportError("libtorch.so: failed to map segment from shared object"),
    ],
)
def test_out_of_memory_has_one_message(error):
    assert system_limit(error) == OUT_OF_MEMORY


@pytest.mark.parametrize("what", ["thread", "process"])
def test_a_limit_of_threads_names_the_repair(what):
    assert "OMP_NUM_THREADS=1" in system_limit(RuntimeError(f"can't start new {what}"))


def test_other_errors_have_no_limit():
    assert system_limit(RuntimeError("shape mismatch")) == ""
    assert system_limit(ValueError("out of memory")) == ""


def test_system_limit_by_example():
    assert system_limit(MemoryError()) == OUT_OF_MEMORY
    assert system_limit(RuntimeError("can't start new thread"))[:24] == "no further thread can be"
    assert system_limit(RuntimeError("shape mismatch")) == ""
