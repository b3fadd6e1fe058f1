"""Actions: those of the robot used by clients, those of clients used from the graph."""

from __future__ import annotations

import json
from typing import Any

import pytest
from conformance_suite import NO_STATUS, Hand, Server, case, fresh_name
from rosbridge_client import Client

FIBONACCI = "/conformance/fibonacci"
TYPE = "example_interfaces/action/Fibonacci"
GOAL = "rosbridge v2, 3.3.12 Send Action Goal"
CANCEL = "rosbridge v2, 3.3.13 Cancel Action Goal"
FEEDBACK = "rosbridge v2, 3.3.14 Action Feedback"
RESULT = "rosbridge v2, 3.3.15 Action Result"
OFFER = "rosbridge v2, 3.3.10 Advertise Action"
WITHDRAW = "rosbridge v2, 3.3.11 Unadvertise Action"
NEEDS_TYPE = "action_type is required (send_action_goal.py, send_action_goal_msg_fields)"
SUCCEEDED, CANCELED, ABORTED, NEVER_BEGAN = 4, 5, 6, 0


@pytest.fixture(autouse=True)
def examples(server: Server) -> None:
    """All of these need example_interfaces on the robot."""
    server.needs_examples()


def pursue(client: Client, order: Any, **fields: Any) -> None:
    """Sends a goal, with id ``goal`` by default."""
    fields = {"id": "goal", "action": FIBONACCI, "action_type": TYPE, "args": {"order": order}, **fields}
    client.send("send_action_goal", **fields)


# --- actions of the robot ---


@case("send_action_goal", GOAL)
def test_goal(client: Client) -> None:
    """A goal is answered with one action_result: action, id, status 4, result true and the values."""
    pursue(client, 5)
    result = client.until("action_result")
    assert result["values"] == {"sequence": [0, 1, 1, 2, 3, 5]}
    assert (result["action"], result["id"], result["status"]) == (FIBONACCI, "goal", SUCCEEDED)
    assert result["result"] is True
    client.none("action_result")


@case("send_action_goal", GOAL + ", feedback")
def test_goal_feedback(client: Client) -> None:
    """With feedback true action_feedback comes before the result, with action, id and values."""
    pursue(client, 4, feedback=True)
    feedback = client.until("action_feedback")
    assert (feedback["action"], feedback["id"]) == (FIBONACCI, "goal")
    assert feedback["values"]["sequence"][:3] == [0, 1, 1]
    assert client.until("action_result")["status"] == SUCCEEDED


@case("send_action_goal", GOAL + ", feedback")
def test_goal_without_feedback(client: Client) -> None:
    """Without feedback only the result comes."""
    pursue(client, 4)
    client.until("action_result")
    client.none("action_feedback", 0.05)


@case("send_action_goal", GOAL + ", args")
def test_goal_list(client: Client) -> None:
    """args may be a list in the order of the fields."""
    pursue(client, 0, args=[3])
    assert client.until("action_result")["values"] == {"sequence": [0, 1, 1, 2]}


@case("send_action_goal", "SPEC 1.2 send_action_goal, action_type", suite=NEEDS_TYPE)
def test_goal_without_type(client: Client) -> None:
    """Without action_type the type comes from the graph."""
    client.send("send_action_goal", id="untyped", action=FIBONACCI, args={"order": 2})
    assert client.until("action_result", id="untyped")["status"] == SUCCEEDED


@case("send_action_goal", GOAL + ", id")
def test_goal_ids(client: Client) -> None:
    """The id comes back as it was, text or number."""
    for name in ("text", 17):
        pursue(client, 1, id=name)
        assert client.until("action_result")["id"] == name


@case("send_action_goal", "SPEC 1.2, names and types")
def test_goal_old_names(client: Client) -> None:
    """An action without leading slash is accepted, and the answers have it as written."""
    pursue(client, 1, action=FIBONACCI.lstrip("/"))
    result = client.until("action_result")
    assert (result["action"], result["status"]) == (FIBONACCI.lstrip("/"), SUCCEEDED)


@case("send_action_goal", GOAL)
def test_goals_in_parallel(client: Client) -> None:
    """Two goals at once each get their own result, the shorter one first."""
    pursue(client, 20, id="long")
    pursue(client, 1, id="short")
    first, second = client.until("action_result"), client.until("action_result")
    assert (first["id"], second["id"]) == ("short", "long")
    assert (len(first["values"]["sequence"]), len(second["values"]["sequence"])) == (2, 21)


@case("send_action_goal", RESULT)
def test_goal_unknown_action(client: Client) -> None:
    """An action that does not exist is answered with result false and a string that says so."""
    pursue(client, 1, action=fresh_name("action"))
    result = client.until("action_result")
    assert result["result"] is False
    assert isinstance(result["values"], str)


@case("send_action_goal", "SPEC 1.2 send_action_goal, always answered")
def test_goal_wrong_args(client: Client) -> None:
    """Arguments that don't fit are answered with result false and a string."""
    for args in ({"order": "many"}, {"wrong": 1}, [1, 2], "text"):
        pursue(client, 0, args=args)
        result = client.until("action_result", id="goal")
        assert result["result"] is False, args
        assert isinstance(result["values"], str)


@case("send_action_goal", "SPEC 1.2 action_result, 0: it never began")
def test_goal_rejected(client: Client) -> None:
    """A goal the robot does not accept is answered with result false, status 0 and a string."""
    pursue(client, 5000)
    result = client.until("action_result", id="goal")
    assert (result["result"], result["status"]) == (False, NEVER_BEGAN)
    assert isinstance(result["values"], str)


@case("send_action_goal", RESULT + ", status")
def test_goal_aborted(client: Client) -> None:
    """A goal the robot gives up has status 6."""
    pursue(client, -1)
    assert client.until("action_result", id="goal")["status"] == ABORTED


@case("cancel_action_goal", CANCEL)
def test_cancel(client: Client) -> None:
    """A goal that is cancelled ends with an action_result of status 5."""
    pursue(client, 200, feedback=True)
    client.until("action_feedback")
    client.send("cancel_action_goal", id="goal", action=FIBONACCI)
    assert client.until("action_result", id="goal")["status"] == CANCELED


@case("cancel_action_goal", CANCEL)
def test_cancel_one_of_two(client: Client) -> None:
    """Only the goal of this id is cancelled."""
    for name in ("one", "two"):
        pursue(client, 10, id=name, feedback=True)
        client.until("action_feedback", id=name)
    client.send("cancel_action_goal", id="one", action=FIBONACCI)
    assert client.until("action_result", id="one")["status"] == CANCELED
    assert client.until("action_result", id="two")["status"] == SUCCEEDED


@case(
    "cancel_action_goal",
    "SPEC 1.2 cancel_action_goal, its own goal",
    suite="goals of all clients share one table (send_action_goal.py)",
)
def test_cancel_of_another(client: Client, server: Server) -> None:
    """A client can't cancel another client's goal."""
    pursue(client, 8, feedback=True)
    client.until("action_feedback")
    with server.connect() as other:
        other.send("cancel_action_goal", id="goal", action=FIBONACCI)
        other.lives()
        assert client.until("action_result", id="goal")["status"] == SUCCEEDED


@case("send_action_goal", "SPEC 1.2 send_action_goal, always answered")
def test_goal_wrong_fields(client: Client) -> None:
    """Fields of a wrong type are answered too: status 0, result false and a string."""
    for number, wrong in enumerate(({"feedback": "yes"}, {"fragment_size": "big"})):
        pursue(client, 3, id=number, **wrong)
        result = client.until("action_result", id=number)
        assert (result["action"], result["status"], result["result"]) == (FIBONACCI, NEVER_BEGAN, False)
        assert isinstance(result["values"], str)


@case("cancel_action_goal", "SPEC 1.3 Errors", suite=NO_STATUS)
def test_cancel_unknown(reported: Client) -> None:
    """Cancelling a goal that does not exist gives an error with a reason."""
    reported.send("cancel_action_goal", id="never", action=FIBONACCI)
    assert reported.until("status", level="error")["msg"]


@case("cancel_action_goal", "SPEC 1.2 send_action_goal, a client that leaves")
def test_cancel_by_leaving(hand: Hand, server: Server) -> None:
    """Goals of a client that leaves are cancelled on the robot."""
    before = int(hand.do("cancelled", "0")[0])
    with server.connect() as leaving:
        pursue(leaving, 500, feedback=True)
        leaving.until("action_feedback")
    assert hand.do("cancelled", str(before + 1)) == [str(before + 1)]


# --- actions that clients offer ---


class Offer:
    """A client that offers an action."""

    def __init__(self, client: Client, hand: Hand, type_name: str = TYPE) -> None:
        self.name = fresh_name("action")
        self.client = client
        self.hand = hand
        client.send("advertise_action", action=self.name, type=type_name)
        client.lives()

    def ask(self, order: int = 3, cancel: bool = False) -> str:
        """The robot sends a goal; returns the id of its result."""
        return self.hand.ask("goal", self.name, TYPE, json.dumps({"order": order}), str(int(cancel)))

    def asked(self) -> dict[str, Any]:
        """The next goal sent to the client."""
        return dict(self.client.until("send_action_goal", action=self.name))

    def feed(self, goal: dict[str, Any], *sequence: int) -> None:
        """Sends feedback."""
        values = {"sequence": list(sequence)}
        self.client.send("action_feedback", action=self.name, id=goal["id"], values=values)

    def finish(self, goal: dict[str, Any], *sequence: int, **fields: Any) -> None:
        """Sends the result."""
        fields = {"result": True, "values": {"sequence": list(sequence)}, **fields}
        self.client.send("action_result", action=self.name, id=goal["id"], **fields)

    def outcome(self, asked: str) -> dict[str, Any]:
        """The robot's result."""
        (answer,) = self.hand.answer(asked, 2 * self.hand.waits)
        return dict(json.loads(answer))


@pytest.fixture
def offer(client: Client, hand: Hand) -> Offer:
    """An action offered by the case's client."""
    return Offer(client, hand)


@case("advertise_action", OFFER)
def test_offer(offer: Offer) -> None:
    """A goal from the robot's graph comes to the client with action, id and args; its result goes back."""
    asked = offer.ask(3)
    goal = offer.asked()
    assert goal["id"] not in (None, "")
    assert goal["args"] == {"order": 3}
    offer.finish(goal, 0, 1, 1, status=SUCCEEDED)
    outcome = offer.outcome(asked)
    assert (outcome["accepted"], outcome["status"]) == (True, SUCCEEDED)
    assert outcome["result"] == {"sequence": [0, 1, 1]}


@case("advertise_action", "rosbridge_library, advertise_action.py")
@pytest.mark.parametrize("spelled", ["example_interfaces/Fibonacci", TYPE])
def test_offer_type(client: Client, hand: Hand, spelled: str) -> None:
    """The goal that comes to the client names the type as the client spelled it, and wants feedback."""
    offer = Offer(client, hand, spelled)
    asked = offer.ask()
    goal = offer.asked()
    assert set(goal) == {"op", "id", "action", "action_type", "args", "feedback"}
    assert (goal["action_type"], goal["feedback"]) == (spelled, True)
    offer.finish(goal, 0, status=SUCCEEDED)
    assert offer.outcome(asked)["status"] == SUCCEEDED


@case("advertise_action", FEEDBACK)
def test_offer_feedback(offer: Offer) -> None:
    """The client's feedback reaches the robot, in order."""
    asked = offer.ask()
    goal = offer.asked()
    offer.feed(goal, 0)
    offer.feed(goal, 0, 1)
    # In ROS 2 feedback and result have different paths: a result may overtake.
    offer.hand.heard(offer.name, 2)
    offer.finish(goal, 0, 1, 1, status=SUCCEEDED)
    assert [each["sequence"] for each in offer.outcome(asked)["feedback"]] == [[0], [0, 1]]


@case("advertise_action", "SPEC 1.2 action_result, from a client without status")
def test_offer_without_status(offer: Offer) -> None:
    """A client's result without status is 4 with result true and 6 with result false."""
    asked = offer.ask()
    offer.finish(offer.asked(), 1)
    assert offer.outcome(asked)["status"] == SUCCEEDED
    asked = offer.ask()
    offer.finish(offer.asked(), result=False, values="could not")
    assert offer.outcome(asked)["status"] == ABORTED


@case("advertise_action", CANCEL)
def test_offer_cancelled(offer: Offer) -> None:
    """A cancel from the robot comes to the client with action and id, and its result of status 5 goes back."""
    asked = offer.ask(cancel=True)
    goal = offer.asked()
    offer.feed(goal, 0)
    cancel = offer.client.until("cancel_action_goal", action=offer.name)
    assert cancel["id"] == goal["id"]
    offer.finish(goal, 0, status=CANCELED)
    assert offer.outcome(asked)["status"] == CANCELED


@case("advertise_action", "SPEC 1.2 advertise_action, an answer from anybody else")
def test_offer_answered_by_another(offer: Offer, server: Server) -> None:
    """A result from a client that was not asked is not accepted."""
    asked = offer.ask()
    goal = offer.asked()
    with server.connect() as other:
        forged = {"action": offer.name, "id": goal["id"], "status": SUCCEEDED, "values": {"sequence": [666]}}
        other.send("action_result", result=True, **forged)
        other.lives()
        offer.finish(goal, 42, status=SUCCEEDED)
        assert offer.outcome(asked)["result"] == {"sequence": [42]}


@case("advertise_action", "SPEC 1.2 advertise_action")
def test_offer_client_leaves(hand: Hand, server: Server) -> None:
    """When the client that offers leaves during a goal, the goal is aborted."""
    with server.connect() as leaving:
        offer = Offer(leaving, hand)
        asked = offer.ask()
        offer.asked()
    assert offer.outcome(asked)["status"] == ABORTED


@case("advertise_action", "SPEC 1.2 advertise_action, offered already", suite=NO_STATUS)
def test_offer_taken(reported: Client) -> None:
    """A name the robot offers already is an error in words."""
    reported.send("advertise_action", action=FIBONACCI, type=TYPE)
    assert reported.until("status", level="error")["msg"]


@case("advertise_action", OFFER, suite=NO_STATUS)
def test_offer_unknown_type(reported: Client) -> None:
    """A type that does not exist is an error in words."""
    reported.send(
        "advertise_action", action=fresh_name("action"), type="example_interfaces/action/NoSuchThing"
    )
    assert reported.until("status", level="error")["msg"]


@case("advertise_action", OFFER)
def test_offer_to_clients(offer: Offer, server: Server) -> None:
    """Other clients can send goals to it too."""
    with server.connect() as other:
        pursue(other, 9, action=offer.name, id="between")
        goal = offer.asked()
        assert goal["args"] == {"order": 9}
        offer.finish(goal, 9, status=SUCCEEDED)
        assert other.until("action_result", id="between")["values"] == {"sequence": [9]}


@case("unadvertise_action", WITHDRAW)
def test_withdraw(offer: Offer) -> None:
    """After unadvertise_action the action is gone from the robot's graph."""
    send_goal = f"{offer.name}/_action/send_goal"
    assert offer.hand.do("offered", send_goal, "1") == ["1"]
    offer.client.send("unadvertise_action", action=offer.name)
    assert offer.hand.do("offered", send_goal, "0") == ["0"]


@case("unadvertise_action", "SPEC 2.5 unadvertise_action")
def test_withdraw_during_goal(offer: Offer) -> None:
    """A goal under way when the action is withdrawn is aborted."""
    asked = offer.ask()
    offer.asked()
    offer.client.send("unadvertise_action", action=offer.name)
    assert offer.outcome(asked)["status"] == ABORTED


@case("unadvertise_action", WITHDRAW)
def test_withdraw_unknown(client: Client) -> None:
    """Withdrawing what was never offered has no effect."""
    client.send("unadvertise_action", action=fresh_name("action"))
    client.lives()
