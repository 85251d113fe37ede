"""Two nodes of one id are told from a node that was restarted."""

from __future__ import annotations

import pytest
from ringdic_controller.rig.processes import NodeProcesses


@pytest.fixture
def processes() -> NodeProcesses:
    """One process that has been heard."""
    processes = NodeProcesses()
    processes.appeared("old", 0)
    processes.heard("old", "pi-a", "10.0.0.1", 10)
    return processes


def test_two_that_speak_at_once_are_named_with_host_and_address(processes):
    assert processes.contradiction("201") == ""
    processes.appeared("new", 100)
    processes.heard("new", "pi-b", "10.0.0.2", 110)
    processes.heard("old", "pi-a", "10.0.0.1", 120)
    sentence = processes.contradiction("201")
    assert "2 nodes have the id 201: pi-a (10.0.0.1), pi-b (10.0.0.2)" in sentence
    processes.gone("new")
    assert processes.contradiction("201") == ""


def test_the_token_of_a_process_that_lost_its_network_is_no_second_node(processes):
    processes.appeared("new", 100)
    processes.heard("new", "pi-a", "10.0.0.1", 5_000)
    assert processes.contradiction("201") == ""
    processes.gone("old")
    assert bool(processes)


def test_a_message_of_a_process_without_a_token_counts_for_nothing(processes):
    processes.heard("stranger", "x", "y", 20)
    processes.appeared("new", 30)
    assert processes.contradiction("201") == ""
