"""The messages between node and controller: round trips, and refusals that name the field."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.errors import InputError
from ringdic.session import names as session_names
from ringdic_node.wire import (
    CAPTURE_KINDS,
    IMAGE_LIMIT,
    NETWORK,
    TRIGGER_VERDICTS,
    Ack,
    Arm,
    ArmReply,
    CaptureKey,
    ClockReading,
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
moments = st.integers(-(2**62), 2**62)
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
    st.builds(Trigger, keys, kinds, counts, clock_zero_ns=st.none() | moments, clock_offset_ns=st.none() | moments),
    st.builds(TriggerReply, names, keys, st.sampled_from(TRIGGER_VERDICTS), texts),
    st.builds(ClockReading, names, counts, st.just(2**62), counts, st.none() | moments, st.none() | st.integers(1, 99)),
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
MANIFEST = Manifest("n", KEY, "board", "0" * 64, bytes=9, width=3, height=3, time_ns=17)


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
        (lambda d: d.pop("schema"), "schema None"),
        (lambda d: d.update(schema="2"), "schema '2'"),
        (lambda d: d.update(schema=2, kind="film"), "'film'.*schema 2.*update"),
        (lambda d: d.update(type="fire"), "'fire'"),
        (lambda d: d.pop("kind"), "'kind' is missing"),
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


def test_a_message_of_another_release_is_understood_as_far_as_it_goes():
    newer = damaged(lambda d: (d.update(schema=2, colour="red"), d["key"].update(room=3)))
    assert decode(newer) == Trigger(KEY, "board")
    older = damaged(lambda d: (d.pop("settings_hash"), d.pop("scene")))
    assert decode(older) == Trigger(KEY, "board")


@given(st.dictionaries(st.from_regex(r"\Anew_[a-z]{1,5}\Z"), st.integers() | st.text(max_size=5), max_size=3))
def test_a_manifest_keeps_the_fields_of_another_release_wherever_it_goes(more):
    document = json.loads(encode(MANIFEST)) | more | {"schema": 3}
    manifest = decode(json.dumps(document).encode())
    assert manifest == replace(MANIFEST, unknown=manifest.unknown)
    listed = json.loads(encode(Inventory("n", (manifest,), delivered=(manifest,))))
    for sent in (json.loads(encode(manifest)), *listed["manifests"], *listed["delivered"]):
        assert {name: sent[name] for name in more} == manifest.unknown


HOSTILE = [
    ('{"a":' * 100_000 + "1" + "}" * 100_000, "deep"),
    ('{"a":' * 300 + "1" + "}" * 300, "nested as deep as json reads"),
    ('{"a":NaN,"b":-Infinity,"c":1e999,"d":' + "9" * 400 + "}", "no finite number"),
    ('{"a":"\\ud800","\\udfff":1}', "half characters"),
    ('{"a":"' + "x" * 100_000 + '"}', "long"),
]


@pytest.mark.parametrize("table", [table for table, _ in HOSTILE], ids=[name for _, name in HOSTILE])
def test_whatever_is_decoded_can_be_stored_and_sent_on(table):
    payload = encode(MANIFEST).replace(b'"metadata":{}', b'"metadata":' + table.encode())
    if table.count("{") > 1000:
        with pytest.raises(WireError, match="nested"):
            decode(payload)
        return
    manifest = decode(payload)
    written = json.dumps(manifest.metadata, allow_nan=False, ensure_ascii=False).encode()
    assert len(written) < 10_000
    assert decode(encode(manifest)) == manifest


def test_what_a_camera_says_never_costs_its_image():
    odd = Manifest(**{**vars(MANIFEST), "metadata": {"Lux": float("nan"), "Gains": (1, 2), "n": 1 << 999}})
    metadata = decode(encode(odd)).metadata
    assert (metadata["Lux"], metadata["Gains"], metadata["n"]) == (None, [1, 2], None)


@pytest.mark.parametrize("payload", [b"", b"\xff\xfe", b"[]", b'"x"', b"{", b"[" * 10**6, b"1" * 10**6, b"NaN"])
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


def test_the_earlier_word_for_a_missed_trigger_is_read():
    assert TriggerReply("n", KEY, "late").verdict == "missed"


@pytest.mark.parametrize("number", [2**63, 10**400, -1])
def test_a_moment_beyond_all_clocks_is_refused(number):
    with pytest.raises(WireError, match="fire_at_ns must be an integer"):
        CaptureKey("s", "0001-board", number)
