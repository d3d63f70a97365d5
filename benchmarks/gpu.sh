#!/usr/bin/env bash
# Measures what needs a GPU, on a machine with one, without a network, in at most 9 minutes.
#
#   OUT=FOLDER benchmarks/gpu.sh [--wheels FOLDER] [--cpu] [--quick]
#   python -m studies.gpu FOLDER          # afterwards, anywhere: the page of results
#
# Needs Python 3.11 or newer, torch 2.11 or newer, and the packages of the extra "experiment" except
# PyBullet. Those that the machine lacks may lie in the folder of --wheels; they are installed
# into a folder of their own for this script. JAX is too large to bring along in 64 MB (jaxlib 0.10.2
# is 85 MB, jax-cuda12-pjrt 174 MB), so it has to be on the machine; Brax 0.14.2 with MuJoCo
# is 18 MB. Without either, that part says so and the others run.
#
# --cpu      on the CPU, to try the script, with four times the limits; the tests are then skipped
# --quick    small: shows that it runs
# PYTHON     the interpreter (python3)
# COMMIT     the commit, for a copy without .git
#
# Each part writes a file to $OUT, has a time limit, and does not stop the others if it fails.
set -uo pipefail
cd "$(dirname "$0")/.."
: "${OUT:?Expected OUT, the folder for the results, got nothing. Set OUT.}"
mkdir -p "$OUT"
OUT=$(cd "$OUT" && pwd)
python=${PYTHON:-python3}
device=cuda wheels='' quick=() scale=1
while (($#)); do
  case $1 in
    --wheels) wheels=${2:?Expected a folder after --wheels.}; shift ;;
    --cpu) device=cpu scale=4 ;;
    --quick) quick=(--quick) ;;
    *) echo "Expected --wheels FOLDER, --cpu or --quick, got '$1'." >&2; exit 2 ;;
  esac
  shift
done
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# The second training on Ant takes the simulation that the first has compiled.
export JAX_COMPILATION_CACHE_DIR=$folder/jax

failed=()
# part NAME SECONDS COMMAND...: its output goes to NAME.log.
part() {
  local name=$1 seconds=$(($2 * scale)) start=$SECONDS status=0
  shift 2
  timeout --kill-after=5 "$seconds" "$@" > "$OUT/$name.log" 2>&1 || status=$?
  ((status == 0)) || failed+=("$name")
  ((status == 124)) && echo "Stopped after $seconds s." >> "$OUT/$name.log"
  echo "$name: exit status $status after $((SECONDS - start)) s"
  ((status == 0)) || tail -n 5 "$OUT/$name.log"
}

if [[ -n $wheels ]]; then
  part install 60 "$python" -m pip install -q --no-index --no-deps --no-compile \
    --target "$folder/site" "$wheels"/*.whl
  export PYTHONPATH=$folder/site:$PYTHONPATH
fi
sizes=(--states 24576 --rounds 5)
ant=(--device "$device" --envs 4096 --iterations 40) limit=$((95 * scale))
if ((${#quick[@]})); then
  sizes=() ant=(--device "$device" --env fast --envs 4 --steps 4 --iterations 2)
fi
# The most important first. With the installation 60 + 60 + 120 + 90 + 210 s.
part cost 60 "$python" -m benchmarks.cost --device "$device" "${sizes[@]}" "${quick[@]}" \
  --json "$OUT/cost.json"
part tests 120 "$python" -m benchmarks.gpu tests --json "$OUT/tests.json"
part speed 90 "$python" -m benchmarks.speed --rows cuda "${quick[@]}" --json "$OUT/speed.json"
part brax 210 "$python" -m benchmarks.gpu brax --json "$OUT/brax.json" --seconds $limit "${ant[@]}"
((${#failed[@]} == 0)) || { echo "Failed: ${failed[*]}" >&2; exit 1; }
