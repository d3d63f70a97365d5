#!/usr/bin/env bash
# Runs the components' tests with the oldest supported versions, the newest, and torchrl's nightly.
#
#   tools/check_versions.sh                  # all three: half an hour, 6 GB of disk
#   tools/check_versions.sh oldest           # or newest, or nightly
#   PYTHON=python3.12 tools/check_versions.sh
set -euo pipefail
cd "$(dirname "$0")/.."

# Tests that need no package of the extra "experiment".
tests="
  adaterm caps checks distances l2c2 loss_contract metrics modules neighborhood pitfalls
  policy_distances ppo_rpe precision properties recurrent regularized rsl_rl several_devices smooth
  transforms updaters
"
tools=(pytest pytest-xdist hypothesis scipy gymnasium)

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

# Of every bound of the components in pyproject.toml, the oldest version that it allows.
oldest_versions() {
  "$1" - <<'PYTHON'
import tomllib

project = tomllib.load(open("pyproject.toml", "rb"))["project"]
for bound in [*project["dependencies"], *project["optional-dependencies"]["rsl-rl"]]:
    print(bound.replace(">=", "=="))
PYTHON
}

make_environment() {
  local name=$1 python=$folder/$1/bin/python
  "${PYTHON:-python3}" -m venv "$folder/$name"
  case $name in
    oldest)
      oldest_versions "$python" > "$folder/oldest.txt"
      "$python" -m pip install -qq -c "$folder/oldest.txt" -e ".[rsl-rl]" "${tools[@]}"
      ;;
    newest)
      "$python" -m pip install -qq -e ".[rsl-rl]" "${tools[@]}"
      ;;
    nightly)
      "$python" -m pip install -qq --pre -e ".[rsl-rl]" "${tools[@]}"
      # The nightly packages have the same folders: the others leave first.
      "$python" -m pip uninstall -qq --yes torchrl tensordict
      "$python" -m pip install -qq --pre torchrl-nightly tensordict-nightly
      ;;
  esac
}

# A line of the table: the versions, and how pytest ended.
line() {
  local name=$1
  "$folder/$name/bin/python" - "$name" "$(tail -n 1 "$folder/$name.log")" <<'PYTHON'
import re
import sys
from importlib.metadata import distributions

name, result = sys.argv[1:]
installed = {each.name.lower(): each.version for each in distributions()}
found = [
    installed.get(package) or installed[f"{package}-nightly"]
    for package in ("torch", "torchrl", "tensordict", "rsl-rl-lib")
]
counts = re.findall(r"\d+ (?:passed|failed|errors?|skipped)", result)
print("|", " | ".join([name, *found, ", ".join(counts) or result]), "|")
PYTHON
}

names=("$@")
((${#names[@]})) || names=(oldest newest nightly)
files=()
for test in $tests; do files+=("tests/test_$test.py"); done
failed=0
lines=()
for name in "${names[@]}"; do
  [[ $name =~ ^(oldest|newest|nightly)$ ]] || {
    echo "Expected oldest, newest or nightly, got '$name'." >&2
    exit 2
  }
  make_environment "$name"
  "$folder/$name/bin/python" -m pytest -n 2 "${files[@]}" torchrl_l2c2 \
    --ignore=torchrl_l2c2/experiment --ignore=torchrl_l2c2/trainers.py \
    > "$folder/$name.log" || {
    failed=1
    grep -E '^(FAILED|ERROR)' "$folder/$name.log" >&2 || cat "$folder/$name.log" >&2
  }
  lines+=("$(line "$name")")
  rm -rf "${folder:?}/$name"
done
echo "| versions | torch | torchrl | tensordict | rsl-rl-lib | tests of the components |"
echo "| --- | --- | --- | --- | --- | --- |"
printf '%s\n' "${lines[@]}"
exit "$failed"
