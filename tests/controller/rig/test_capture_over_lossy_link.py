"""Node agents and capture rounds joined by a link that drops, repeats, delays, reorders and damages messages."""

from __future__ import annotations

import hashlib
import heapq
import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass, field

from hypothesis import given, settings
from hypothesis import strategies as st
from ringdic_controller.rig import capture as round_
from ringdic_controller.rig.capture import MS, SECOND, CaptureRound, Timing
from ringdic_controller.rig.judgement import judge
from ringdic_node import agent as node_
from ringdic_node.agent import Agent
from ringdic_node.clock import Instant
from ringdic_node.wire import Ack, Arm, ArmReply, CaptureKey, Failure, Inventory, Manifest, Trigger, TriggerReply

START = 1_000 * SECOND
HASH = "0" * 64
TIMING = Timing(
    arm=3 * SECOND,
    arm_retry=300 * MS,
    lead=400 * MS,
    trigger_retry=80 * MS,
    pull_after=1 * SECOND,
    pull_every=500 * MS,
    collect=8 * SECOND,
    gone_grace=500 * MS,
)


@dataclass
class Weather:
    """How bad the link is; probabilities and the longest delay in ns."""

    drop: float
    repeat: float
    damage: float
    delay: int
    forge: float = 0.0


@dataclass
class World:
    """Event queue with a clock: everything that happens, happens here."""

    random: random.Random
    weather: Weather
    now: int = START
    queue: list[tuple[int, int, Callable[[], None]]] = field(default_factory=list)
    numbers: itertools.count = field(default_factory=itertools.count)

    def after(self, wait: int, act: Callable[[], None]) -> None:
        heapq.heappush(self.queue, (self.now + wait, next(self.numbers), act))

    def send(self, act: Callable[[], None]) -> None:
        """Deliver a message never, once or twice, each time after its own delay."""
        if self.random.random() < self.weather.drop:
            return
        for _ in range(2 if self.random.random() < self.weather.repeat else 1):
            self.after(self.random.randrange(1, self.weather.delay + 2), act)

    def run(self, until: int, over: Callable[[], bool] = lambda: False) -> None:
        while self.queue and self.queue[0][0] <= until and not over():
            self.now, _, act = heapq.heappop(self.queue)
            act()
        if not over():
            self.now = max(self.now, until)


class SimulatedNode:
    """An agent with a camera, a durable spool and a life that may end and begin anew."""

    def __init__(self, world: World, name: str, controller: SimulatedController) -> None:
        self.world, self.name, self.controller = world, name, controller
        self.spool: dict[CaptureKey, tuple[Manifest, bytes]] = {}
        self.freed: dict[CaptureKey, str] = {}
        self.images: dict[CaptureKey, bytes] = {}
        self.born = 0
        self.questions: dict[int, Callable] = {}
        self.numbers = itertools.count()
        self.agent: Agent | None = None
        self.start()

    def start(self) -> None:
        self.agent = Agent(
            self.name,
            self.instant(),
            spooled=[manifest for key, (manifest, _) in self.spool.items() if key not in self.freed],
            delivered=[manifest for key, (manifest, _) in self.spool.items() if key in self.freed],
            freed=list(self.freed),
            resend_after_ns=700 * MS,
        )
        self.tick(self.born)

    def die(self, rest: int) -> None:
        self.born += 1
        self.agent = None
        self.questions.clear()
        self.world.after(5 * MS, lambda: self.controller.tell(round_.NodeGone(self.name)))
        self.world.after(rest, self.revive)

    def revive(self) -> None:
        if self.agent is None:
            self.start()
            self.world.after(5 * MS, lambda: self.controller.tell(round_.NodeBack(self.name)))

    def instant(self) -> Instant:
        return Instant(self.world.now, self.world.now)

    def tick(self, life: int) -> None:
        if life == self.born and self.agent is not None:
            self.handle(node_.AgentTick())
            self.world.after(100 * MS, lambda: self.tick(life))

    def ask(self, make: Callable[[int], node_.Event], reply: Callable) -> None:
        if self.agent is not None:
            question = next(self.numbers)
            self.questions[question] = reply
            self.handle(make(question))

    def handle(self, event: node_.Event) -> None:
        if self.agent is None:
            return
        for action in self.agent.handle(event, self.instant()):
            self.perform(action)

    def later(self, wait: int, event: Callable[[], node_.Event]) -> None:
        """An event of this life; it is lost if the node dies first."""
        life = self.born
        self.world.after(wait, lambda: self.handle(event()) if life == self.born else None)

    def perform(self, action: node_.Action) -> None:
        world = self.world
        match action:
            case node_.LockCamera():
                reply = ArmReply(self.name, armed=True, settings_hash=action.settings_hash)
                self.later(20 * MS, lambda: node_.CameraLocked(reply))
            case node_.TakeFrame():
                key = action.trigger.key
                assert key not in self.images, "a capture is taken at most once"
                wait = key.fire_at_ns - world.now + world.random.randrange(200 * MS)
                if world.random.random() < 0.1:
                    self.later(wait, lambda: node_.FrameLost(key, "the camera timed out"))
                else:
                    self.later(wait, lambda: self.spooled(action.trigger))
            case node_.Publish():
                key = action.manifest.key
                manifest, image = self.spool[key]
                world.send(lambda: self.controller.image(manifest, image))
                self.later(10 * MS, lambda: node_.Sent(key))
                if world.random.random() < world.weather.forge:  # somebody has read the hash from the network
                    forged = Ack(self.name, key, manifest.sha256)
                    world.after(1, lambda: self.handle(node_.Acknowledged(forged)))
            case node_.Free():
                manifest, _ = self.spool[action.key]
                assert manifest.sha256 == action.sha256
                self.freed[action.key] = action.sha256
            case node_.Report():
                world.send(lambda: self.controller.tell(round_.FailureReported(action.failure)))
            case node_.Answer():
                reply = self.questions.pop(action.question)
                world.send(lambda: reply(action.message))
            case node_.AnswerImage():
                self.questions.pop(action.question)
                manifest, image = self.spool[action.manifest.key]
                world.send(lambda: self.controller.image(manifest, image))
            case node_.Decline():
                self.questions.pop(action.question)

    def spooled(self, trigger: Trigger) -> node_.Event:
        image = f"{self.name} {trigger.key} {self.world.random.random()}".encode()
        self.images[trigger.key] = image
        manifest = Manifest(
            node=self.name,
            key=trigger.key,
            kind=trigger.kind,
            sha256=hashlib.sha256(image).hexdigest(),
            bytes=len(image),
            width=1,
            height=1,
            time_ns=self.world.now,
        )
        self.spool[trigger.key] = manifest, image
        return node_.FrameSpooled(manifest)


class SimulatedController:
    """Capture rounds, an archive in a dictionary, and the reconciliation between rounds."""

    def __init__(self, world: World, cameras: list[str]) -> None:
        self.world = world
        self.nodes = {name: SimulatedNode(world, name, self) for name in cameras}
        self.records: dict[str, int] = {}
        self.archive: dict[tuple[str, str], bytes] = {}
        self.outcomes: dict[str, dict[str, round_.CameraOutcome]] = {}
        self.refusals: dict[str, str] | None = None
        self.round: CaptureRound | None = None
        self.capture_id = ""

    def capture(self, capture_id: str, override: bool) -> None:
        """Run one round until it is over; fail if it outlives its deadline."""
        self.capture_id = capture_id
        absent = [name for name, node in self.nodes.items() if node.agent is None]
        self.round = CaptureRound(self.nodes, TIMING, self.world.now, absent=absent, override=override)
        self.refusals = None
        self.beat()
        longest = self.world.now + TIMING.arm + TIMING.lead + TIMING.collect + 50 * MS
        self.world.run(longest, over=lambda: self.round.over)
        assert self.round.over, "a round ends by its deadline"
        if self.round.deadline is not None:
            assert self.world.now <= self.round.deadline + 50 * MS

    def beat(self) -> None:
        if self.round is not None and not self.round.over:
            self.tell(round_.RoundTick())
            self.world.after(20 * MS, self.beat)

    def tell(self, event: round_.Event) -> None:
        if self.round is not None:
            for action in self.round.handle(event, self.world.now):
                self.perform(action)

    def perform(self, action: round_.Action) -> None:
        match action:
            case round_.SendArm():
                for name in action.cameras:
                    arm = Arm("s", "board", {}, HASH, tuple(self.nodes))
                    self.ask(name, lambda q, arm=arm: node_.ArmAsked(arm, q), round_.ArmAnswered)
            case round_.OpenCapture():
                self.records[self.capture_id] = action.fire_at_ns
                self.tell(round_.CaptureOpened(CaptureKey("s", self.capture_id, action.fire_at_ns)))
            case round_.SendTrigger():
                for name in action.cameras:
                    trigger = Trigger(action.key, "board")
                    self.ask(name, lambda q, t=trigger: node_.Triggered(t, q), round_.TriggerAnswered)
            case round_.AskInventory():
                for name in action.cameras:
                    self.ask(name, node_.InventoryAsked, round_.InventoryAnswered)
            case round_.FetchImage():
                self.fetch(action.manifest)
            case round_.RefuseRound():
                self.refusals = action.reasons
            case round_.CloseCapture():
                self.outcomes[self.capture_id] = action.outcomes
                for name, outcome in action.outcomes.items():
                    archived = (self.capture_id, name) in self.archive
                    assert (outcome.status == "ok") == archived, (name, outcome)

    def ask(self, name: str, make: Callable[[int], node_.Event], wrap: Callable) -> None:
        node = self.nodes[name]
        self.world.send(lambda: node.ask(make, lambda message: self.tell(wrap(message))))

    def fetch(self, manifest: Manifest) -> None:
        node = self.nodes[manifest.node]
        self.world.send(lambda: node.ask(lambda q: node_.FetchAsked(manifest.key, q), lambda message: None))

    def image(self, manifest: Manifest, image: bytes) -> None:
        if self.world.random.random() < self.world.weather.damage:
            image = image[:-1]
        archived = dict.fromkeys(self.nodes)
        image_here = self.archive.get((manifest.key.capture_id, manifest.node))
        if image_here is not None:
            archived[manifest.node] = hashlib.sha256(image_here).hexdigest()
        verdict = judge(
            manifest,
            hashlib.sha256(image).hexdigest(),
            len(image),
            self.records.get(manifest.key.capture_id),
            archived,
        ).verdict
        if verdict in ("archive", "repeat"):
            self.archive.setdefault((manifest.key.capture_id, manifest.node), image)
            self.acknowledge(manifest)
            self.tell(round_.ImageArchived(manifest))

    def acknowledge(self, manifest: Manifest) -> None:
        ack = Ack(manifest.node, manifest.key, manifest.sha256)
        node = self.nodes[manifest.node]
        self.world.send(lambda: node.handle(node_.Acknowledged(ack)))

    def check(self) -> None:
        """What must hold at every moment."""
        for (capture_id, name), image in self.archive.items():
            key = CaptureKey("s", capture_id, self.records[capture_id])
            assert self.nodes[name].images[key] == image, "only what the node took is archived"
        for name, node in self.nodes.items():
            for key, sha256 in node.freed.items():
                image = self.archive.get((key.capture_id, name), self.nodes[name].spool[key][1])
                assert hashlib.sha256(image).hexdigest() == sha256, "only what is archived may be removed"


@settings(max_examples=120, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    drop=st.floats(0, 0.6),
    repeat=st.floats(0, 0.6),
    damage=st.floats(0, 0.3),
    delay_ms=st.integers(0, 900),
    deaths=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 4000), st.integers(50, 6000)), max_size=3),
    override=st.booleans(),
)
def test_nothing_is_lost_or_wrong_whatever_the_link_does(seed, drop, repeat, damage, delay_ms, deaths, override):
    world = World(random.Random(seed), Weather(drop, repeat, damage, delay_ms * MS))
    controller = SimulatedController(world, ["a", "b", "c"])
    nodes = list(controller.nodes.values())
    for victim, moment_ms, rest_ms in deaths:
        node = nodes[victim]
        world.after(moment_ms * MS, lambda node=node, rest=rest_ms * MS: node.die(rest) if node.agent else None)
    for capture_id in ("0001-board", "0002-board"):
        controller.capture(capture_id, override)
        controller.check()
        if controller.refusals is not None:
            assert capture_id not in controller.records
            assert all(controller.refusals.values()), "every refusal tells its reason"
        for outcome in controller.outcomes.get(capture_id, {}).values():
            assert outcome.status in ("ok", "failed")
            assert outcome.status == "ok" or outcome.reason

    # When the storm is over, everything that was spooled reaches the archive and is freed.
    world.weather = Weather(0, 0, 0, 5 * MS)
    world.run(world.now + 130 * SECOND)
    controller.check()
    for node in nodes:
        assert set(node.spool) == set(node.freed)
        for key in node.images:
            assert (key.capture_id, node.name) in controller.archive


def test_a_perfect_link_gives_a_perfect_capture():
    world = World(random.Random(1), Weather(0, 0, 0, 1 * MS))
    controller = SimulatedController(world, ["a", "b", "c"])
    for node in controller.nodes.values():
        node.world.random.random = lambda: 0.99  # no camera fails
    controller.capture("0001-board", override=False)
    assert {o.status for o in controller.outcomes["0001-board"].values()} == {"ok"}


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), drop=st.floats(0, 0.4))
def test_images_whose_acknowledgements_are_forged_are_pulled_by_the_round(seed, drop):
    world = World(random.Random(seed), Weather(drop, 0, 0, 50 * MS, forge=1.0))
    controller = SimulatedController(world, ["a", "b", "c"])
    controller.capture("0001-board", override=True)
    for name, outcome in controller.outcomes.get("0001-board", {}).items():
        taken = bool(controller.nodes[name].images)
        assert outcome.status == "ok" or not taken or drop > 0.2, outcome


def armed(camera: str, settings_hash: str = HASH) -> round_.ArmAnswered:
    return round_.ArmAnswered(ArmReply(camera, armed=True, settings_hash=settings_hash))


def test_a_camera_that_is_locked_to_other_settings_is_not_armed():
    machine = CaptureRound(["a", "b"], TIMING, START, settings_hash=HASH)
    machine.handle(armed("a"), START)
    machine.handle(armed("b", "1" * 64), START)
    (refusal,) = machine.handle(round_.RoundTick(), START + TIMING.arm)
    assert "other settings (11111111…)" in refusal.reasons["b"]
    assert list(refusal.reasons) == ["b"]


def test_two_nodes_of_one_id_are_refused_at_once_whatever_they_answer():
    machine = CaptureRound(["a", "b"], TIMING, START, doubled={"b": "2 nodes have the id b"})
    assert machine.handle(round_.RoundTick(), START) == [round_.SendArm(("a",))]
    machine.handle(armed("b"), START)
    (refusal,) = machine.handle(armed("a"), START + MS)
    assert refusal == round_.RefuseRound({"b": "not armed: 2 nodes have the id b"})


def test_a_second_node_that_appears_while_the_rig_arms_is_noticed_and_one_that_goes_is_no_hindrance():
    machine = CaptureRound(["a", "b"], TIMING, START)
    machine.handle(armed("b"), START)
    machine.handle(round_.NodeDoubled("b", "2 nodes have the id b"), START)
    machine.handle(round_.NodeDoubled("b", ""), START + MS)
    (opening,) = machine.handle(armed("a"), START + 2 * MS)
    assert opening.unarmed == {}
    assert sorted(opening.armed) == ["a", "b"]


def test_an_operator_may_capture_without_the_doubled_camera():
    machine = CaptureRound(["a", "b"], TIMING, START, doubled={"b": "2 nodes have the id b"}, override=True)
    machine.handle(armed("b"), START)
    note, opening = machine.handle(armed("a"), START)
    assert note.outcome.reason == opening.unarmed["b"] == "not armed: 2 nodes have the id b"
    assert list(opening.armed) == ["a"]


def test_a_message_of_another_round_changes_nothing():
    machine = CaptureRound(["a"], TIMING, START)
    machine.handle(round_.ArmAnswered(ArmReply("a", armed=True, settings_hash=HASH)), START)
    key, other = CaptureKey("s", "0002-board", START + SECOND), CaptureKey("s", "0001-board", START)
    machine.handle(round_.CaptureOpened(key), START)
    machine.handle(round_.FailureReported(Failure("a", other, "old news")), START)
    machine.handle(round_.TriggerAnswered(TriggerReply("a", other, "late", "old news")), START)
    machine.handle(round_.InventoryAnswered(Inventory("b")), START)
    assert machine.pending == ("a",)
