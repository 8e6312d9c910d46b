"""A withdrawn fact ends the daemon's own correction and does not affect the next client that arms."""

from __future__ import annotations

from pathlib import Path

from tests.guard.guard_rig import TOKEN, GuardRig
from tests.guard.simulated_bus import DIGEST, FACTS_GIVEN


def test_withdrawn_facts_do_not_affect_the_next_client_that_arms(tmp_path: Path) -> None:
    shop = GuardRig(tmp_path)
    try:
        first = shop.into_the_cut()
        first.send(b'{"request": "alive", "facts": {"model_fresh": false}}\n')
        shop.run(150)
        assert (shop.state, shop.events()[-1]["code"]) == ("OFF", "ModelStale")
        first.close()
        shop.playing, shop.row = False, 0
        shop.run(150)
        armed = {"request": "arm", "token": TOKEN, "program_digest": DIGEST, "facts": dict(FACTS_GIVEN)}
        assert shop.ask(shop.connect(), armed)["ok"]
        shop.run(5)
        assert shop.state == "ARMED"
    finally:
        shop.close()
