"""A withdrawn fact ends the daemon's own correction and does not affect the next client that arms."""

from __future__ import annotations

from pathlib import Path

from tests.guard.machine import DIGEST, FACTS_GIVEN
from tests.guard.shop import TOKEN, Shop


def test_the_next_to_arm_is_judged_by_what_he_vouches_for(tmp_path: Path) -> None:
    shop = Shop(tmp_path)
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
