#!/bin/sh
# Make a SUMO town of five by five signalised crossings, run it 160 times, and study it: `sh examples/sumo_town.sh`.
# Needs `pip install 'study[sumo]'`. reports/reference/heads-sumo came from these commands.
set -e
tools=$(python -c "import pathlib, sumo; print(pathlib.Path(sumo.SUMO_HOME) / 'tools')")
mkdir -p sumo-town
netgenerate --grid --grid.number 5 --grid.length 90 --grid.attach-length 90 --perturb-x "norm(0,7)" \
  --perturb-y "norm(0,7)" --default.lanenumber 2 --random-lanenumber --default.speed 11.11 \
  --default-junction-type traffic_light --tls.green.time 15 --no-turnarounds true --seed 0 --output-file sumo-town/town.net.xml
# Vehicles of 300 flows depart at random, so that each of the 160 runs has other traffic.
python "$tools/randomTrips.py" -n sumo-town/town.net.xml -o sumo-town/trips.xml -r sumo-town/town.rou.xml -e 300 \
  --period 0.9 --flows 300 --poisson --fringe-factor 3 --min-distance 200 --seed 0 --validate
cat > sumo-town/town.sumocfg <<'EOF'
<configuration>
  <input><net-file value="town.net.xml"/><route-files value="town.rou.xml"/></input>
  <time><end value="300"/></time>
</configuration>
EOF
python -m study.data convert sumo sumo-town/town.sumocfg --drives 160 --warm-up 90 --seconds 24 --out sumo-drives
python -m study.data import sumo-drives
python -m study.sweep heads --data data/imported/sumo-drives
