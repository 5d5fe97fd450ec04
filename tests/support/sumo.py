"""A SUMO net of one road with a light, and FCD output of vehicles on it, as SUMO writes them."""

from __future__ import annotations

from pathlib import Path

NET = """<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,220,10" origBoundary="0,0,220,10" projParameter="!"/>
  <edge id=":J_0" function="internal">
    <lane id=":J_0_0" index="0" speed="10" length="10" shape="105,1.6 115,1.6"/>
    <lane id=":J_0_1" index="1" speed="10" length="10" shape="105,4.8 115,4.8"/>
  </edge>
  <edge id="in" from="A" to="J">
    <lane id="in_0" index="0" speed="10" length="105" shape="0,1.6 105,1.6"/>
    <lane id="in_1" index="1" speed="10" length="105" width="3.5" shape="0,4.8 105,4.8"/>
    <lane id="in_2" index="2" speed="10" length="105" allow="pedestrian" shape="0,8 105,8"/>
  </edge>
  <edge id="out" from="J" to="B">
    <lane id="out_0" index="0" speed="20" length="105" shape="115,1.6 220,1.6"/>
    <lane id="out_1" index="1" speed="20" length="105" shape="115,4.8 220,4.8"/>
  </edge>
  <tlLogic id="J" type="static" programID="0" offset="2">
    <phase duration="4" state="rr"/><phase duration="5" state="Gg"/><phase duration="1" state="yy"/>
  </tlLogic>
  <connection from="in" to="out" fromLane="0" toLane="0" via=":J_0_0" tl="J" linkIndex="0" dir="s" state="O"/>
  <connection from="in" to="out" fromLane="1" toLane="1" via=":J_0_1" tl="J" linkIndex="1" dir="s" state="O"/>
  <connection from=":J_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
  <connection from=":J_0" to="out" fromLane="1" toLane="1" dir="s" state="M"/>
</net>
"""
SPEED = 8.0  # [m/s]


def lane_at(x: float, index: int) -> str:
    """Return the lane in which a front bumper is."""
    return f"in_{index}" if x <= 105 else f":J_0_{index}" if x <= 115 else f"out_{index}"


def write_net(folder: Path, text: str = NET) -> Path:
    """Write the net and return its path."""
    path = folder / "road.net.xml"
    path.write_text(text)
    return path


def write_fcd(folder: Path, period: float = 0.1, change: tuple[str, str] = ("", "")) -> Path:
    """Write 20 s of two cars that drive east at 8 m/s; the second changes to the left lane at once, 60 m on."""
    rows = []
    for step in range(round(20 / period)):
        time, cars = step * period, []
        for name, start in (("a", 40.0), ("b", 20.0)):
            x = start + SPEED * time
            index = int(name == "b" and x > 80)
            place = f'x="{x:.2f}" y="{(1.6, 4.8)[index]:.2f}" angle="90.00" lane="{lane_at(x, index)}"'
            cars.append(f'<vehicle id="{name}" {place} type="DEFAULT_VEHTYPE" speed="{SPEED:.2f}" pos="0"/>')
        rows.append(f'<timestep time="{time:.2f}">{"".join(cars)}</timestep>')
    path = folder / "fcd.xml"
    path.write_text(
        f"<fcd-export>{''.join(rows)}</fcd-export>".replace(*change, 1)
        if change[0]
        else f"<fcd-export>{''.join(rows)}</fcd-export>"
    )
    return path
