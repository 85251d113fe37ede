"""The messages between node and controller: round trips, and refusals that name the field."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.errors import InputError
from ringdic.session import names as session_names
from ringdic_node.wire import (
    CAPTURE_KINDS,
    IMAGE_LIMIT,
    NETWORK,
    Ack,
    Arm,
    ArmReply,
    CaptureKey,
    Failure,
    Fetch,
    Inventory,
    Keys,
    Manifest,
    NodeStatus,
    Trigger,
    TriggerReply,
    WireError,
    decode,
    decode_as,
    encode,
    valid_name,
)

names = st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,20}\Z")
hashes = st.from_regex(r"\A[0-9a-f]{64}\Z")
texts = st.text(min_size=1, max_size=20)
counts = st.integers(0, 2**62)
tables = st.dictionaries(st.text(max_size=5), st.one_of(st.integers(), st.text(max_size=5), st.none()), max_size=3)
keys = st.builds(CaptureKey, names, names, counts)
kinds = st.sampled_from(CAPTURE_KINDS)
manifests = st.builds(
    Manifest,
    node=names,
    key=keys,
    kind=kinds,
    sha256=hashes,
    bytes=st.integers(1, IMAGE_LIMIT),
    width=st.integers(1, 9999),
    height=st.integers(1, 9999),
    time_ns=counts,
    exposure_us=st.none() | st.floats(1, 1e6),
    metadata=tables,
)
failures = st.builds(Failure, names, keys, texts)
messages = st.one_of(
    st.builds(Arm, names, kinds, tables, hashes, st.lists(names, max_size=3).map(tuple)),
    st.builds(ArmReply, names, st.booleans(), hashes, texts, tables, clock_offset_ms=st.none() | st.floats(-9, 9)),
    st.builds(Trigger, keys, kinds, counts),
    st.builds(TriggerReply, names, keys, st.sampled_from(["accepted", "late", "not armed"]), texts),
    manifests,
    failures,
    st.builds(
        Inventory,
        names,
        st.lists(manifests, max_size=2).map(tuple),
        st.lists(failures, max_size=2).map(tuple),
        st.none() | keys,
    ),
    st.builds(Fetch, keys),
    st.builds(Ack, names, keys, hashes, st.sampled_from(["archived", "unknown"])),
    st.builds(NodeStatus, names, st.sampled_from(["idle", "armed"]), st.booleans(), counts, counts, counts),
)

KEY = CaptureKey("s", "0001-board", 17)


@given(messages)
def test_what_is_encoded_is_decoded(message):
    assert decode(encode(message)) == message


def test_a_key_becomes_a_file_name_and_keeps_apart_sessions_of_one_name():
    again = CaptureKey("s", "0001-board", 18)
    assert KEY.stem == "s~0001-board~17"
    assert KEY.stem != again.stem


@pytest.mark.parametrize("name", ["", "a/b", "a~b", "*", "..", ".hidden", "a b", "x" * 65, 7, None])
def test_a_name_that_could_leave_its_folder_or_key_is_refused(name):
    with pytest.raises(WireError):
        CaptureKey(name, "0001-board", 0)
    with pytest.raises(WireError):
        Keys(name)


def damaged(change) -> bytes:
    document = json.loads(encode(Trigger(KEY, "board")))
    change(document)
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda d: d.update(schema=2), "schema 2"),
        (lambda d: d.pop("schema"), "schema None"),
        (lambda d: d.update(type="fire"), "'fire'"),
        (lambda d: d.pop("kind"), "'kind' is missing"),
        (lambda d: d.update(colour="red"), "unknown field 'colour'"),
        (lambda d: d.update(kind="film"), "'film'"),
        (lambda d: d.update(scene=True), "'scene'"),
        (lambda d: d.update(scene=-1), "scene"),
        (lambda d: d.update(key="s/0001"), "'key'"),
        (lambda d: d["key"].pop("session"), "'session' is missing"),
        (lambda d: d["key"].update(fire_at_ns="soon"), "'fire_at_ns'"),
    ],
)
def test_a_broken_message_is_refused_with_the_field_named(change, told):
    with pytest.raises(WireError, match=told):
        decode(damaged(change))


@pytest.mark.parametrize("payload", [b"", b"\xff\xfe", b"[]", b'"x"', b"{"])
def test_what_is_no_message_is_refused(payload):
    with pytest.raises(WireError):
        decode(payload)


def test_a_message_of_another_type_is_refused():
    with pytest.raises(WireError, match="expected a message of type 'arm'"):
        decode_as(Arm, encode(Fetch(KEY)))


def test_a_refusal_without_a_reason_cannot_exist():
    with pytest.raises(WireError, match="reason"):
        ArmReply("n", armed=False, settings_hash="0" * 64)
    with pytest.raises(WireError, match="reason"):
        Failure("n", KEY, "")


def test_an_image_that_the_network_would_drop_silently_cannot_be_announced():
    limit = NETWORK["transport/link/rx/max_message_size"]
    with pytest.raises(WireError, match="too large"):
        Manifest("n", KEY, "board", "0" * 64, bytes=limit, width=1, height=1, time_ns=0)


def test_a_frozen_receiver_is_given_up_before_its_lease_ends():
    wait_us = NETWORK["transport/link/tx/queue/congestion_control/block/wait_before_close"]
    assert wait_us < 1000 * NETWORK["transport/link/tx/lease"]


def test_the_kinds_of_capture_are_those_of_the_session():
    assert session_names.CAPTURE_KINDS == CAPTURE_KINDS


@given(st.one_of(names, st.text(max_size=70), st.from_regex(r"\A[A-Za-z0-9._~/ -]{0,70}\Z")))
def test_a_name_is_one_in_messages_where_it_is_one_in_a_session(name):
    def verdict(check, refusal):
        try:
            return check("the name", name)
        except refusal as error:
            return str(error)

    assert verdict(valid_name, WireError) == verdict(session_names.checked_name, InputError)
