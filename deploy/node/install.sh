#!/usr/bin/env bash
# Installs a release of ringdic on a camera node beside the earlier ones, checks it, and only then makes it current.
#
#   PREFIX/releases/<name>/venv     a virtual environment with the release; never changed afterwards
#   PREFIX/releases/<name>/unit     the systemd unit that came with it
#   PREFIX/current, PREFIX/previous links to releases
#
# Exit codes: 0 done, 2 wrong use or bad input, 3 the release was refused or could not be installed.
set -euo pipefail

readonly SERVICE=ringdic-node
readonly USER_NAME=ringdic
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
readonly here

usage() {
  cat <<'TEXT'
usage: install.sh WHEEL [--release NAME] [--wheels DIR] [--no-check] [--root DIR]
       install.sh --back [NAME] [--root DIR]
       install.sh --list [--root DIR]

  WHEEL           the file ringdic-<version>-py3-none-any.whl
  --release NAME  name of the release (default: the version in the wheel's name)
  --wheels DIR    take eclipse-zenoh from this folder instead of from the network
  --no-check      make the release current although nothing has checked it (the controller is not up yet)
  --back [NAME]   make the previous release, or the one named, current again
  --list          the releases installed
  --root DIR      trial: install below DIR; packages, users, services and clocks of this machine are left alone
TEXT
}

say() { printf '%s\n' "install: $*" >&2; }
refuse() { say "$*"; exit 2; }
give_up() { say "$*"; exit 3; }

# --- what is asked

wheel='' release='' wheels='' root='' action=install checked=yes
while (($#)); do
  case $1 in
    --release | --wheels | --root)
      (($# >= 2)) || refuse "$1 needs a value"
      case $1 in
        --release) release=$2 ;;
        --wheels) wheels=$2 ;;
        --root) root=$2 ;;
      esac
      shift
      ;;
    --no-check) checked=no ;;
    --back) action=back ;;
    --list) action=list ;;
    -h | --help) usage; exit 0 ;;
    -*) usage >&2; refuse "unknown option $1" ;;
    *)
      if [[ $action == back ]]; then release=$1; else wheel=$1; fi
      ;;
  esac
  shift
done

if [[ -n $root ]]; then
  mkdir -p "$root"
  root=$(cd "$root" && pwd)
elif ((EUID != 0)); then
  refuse "run it as root: sudo $0 …"
fi
readonly prefix=$root/opt/ringdic config=$root/etc/ringdic/node.toml state=$root/var/lib/ringdic

# --- steps

on_this_machine() { [[ -z $root ]]; }

packages() {
  # picamera2 and numpy come from apt: picamera2 must match libcamera, and numpy must match picamera2.
  local missing=() package
  for package in python3-picamera2 python3-numpy python3-venv chrony; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
  done
  if ((${#missing[@]})); then
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "${missing[@]}"
  fi
}

account() {
  id -u "$USER_NAME" >/dev/null 2>&1 ||
    useradd --system --user-group --groups video --home-dir /var/lib/ringdic --shell /usr/sbin/nologin "$USER_NAME"
  install -d -o "$USER_NAME" -g "$USER_NAME" -m 0750 "$state"
  if [[ -d ${config%/*}/certificates ]]; then # root keeps them; the service may read its key, and nobody else
    chown -R "root:$USER_NAME" "${config%/*}/certificates"
    chmod -R u=rwX,g=rX,o= "${config%/*}/certificates"
  fi
}

build() { # build FOLDER: the release, complete or absent; every step says so itself, for `set -e` sleeps in a condition
  local folder=$1 sources=()
  [[ -n $wheels ]] && sources=(--no-index --find-links "$wheels")
  rm -rf "$folder"
  mkdir -p "$folder" || return
  python3 -m venv --system-site-packages "$folder/venv" || return
  "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check --only-binary :all: \
    ${sources[@]+"${sources[@]}"} "$wheel" || return
  if compgen -G "$folder/venv/lib/python3*/site-packages/numpy" >/dev/null; then
    say "numpy was not taken from apt; picamera2 may not work beside it (apt-get install python3-numpy)"
    return 1
  fi
  install -D -m 0644 "$here/$SERVICE.service" "$folder/unit/$SERVICE.service" || return
  touch "$folder/complete"
}

as_service_user() {
  if on_this_machine; then (cd / && runuser -u "$USER_NAME" -- "$@"); else "$@"; fi
}

controller_address() { # controller_address VENV: the host in the node's configuration; fails if it is not sound
  "$1/bin/python" - "$config" <<'PYTHON'
import pathlib, sys
from ringdic_node.config import ConfigError, read_node_config
try:
    endpoint = read_node_config(pathlib.Path(sys.argv[1])).controller
except ConfigError as error:
    sys.exit(f"install: {error}")
print(endpoint.partition("/")[2].partition("#")[0].rpartition(":")[0].strip("[]"))
PYTHON
}

settle() { # settle ADDRESS: clock and journal of the node
  local conf=$root/etc/chrony/chrony.conf fresh
  fresh=$(sed "s/@CONTROLLER@/$1/" "$here/chrony.conf")
  mkdir -p "${conf%/*}"
  if [[ ! -f $conf ]] || [[ $(<"$conf") != "$fresh" ]]; then
    if [[ -f $conf ]]; then cp -n "$conf" "$conf.before-ringdic"; fi
    printf '%s\n' "$fresh" >"$conf"
    if on_this_machine; then systemctl restart chrony; fi
  fi
  install -D -m 0644 "$here/journald.conf" "$root/etc/systemd/journald.conf.d/ringdic.conf"
}

point() { # point LINK NAME: in one step, so that there is a current release at every moment
  ln -sfn "releases/$2" "$prefix/.$1.new"
  mv -T "$prefix/.$1.new" "$prefix/$1"
}

named() { if [[ -L $prefix/$1 ]]; then basename "$(readlink "$prefix/$1")"; fi; }

stopped=no
stop_service() { # whatever happens until the next start, the service does not stay stopped
  if on_this_machine && systemctl is-active --quiet "$SERVICE"; then
    stopped=yes
    trap 'if [[ $stopped == yes ]]; then systemctl start "$SERVICE"; fi' EXIT
    systemctl stop "$SERVICE"
  fi
}

start_service() { # the unit of the current release; fails if the service does not stay up
  install -D -m 0644 "$prefix/current/unit/$SERVICE.service" "$root/etc/systemd/system/$SERVICE.service" || return
  on_this_machine || return 0
  systemctl daemon-reload || return
  systemctl enable --quiet "$SERVICE" || return
  systemctl restart "$SERVICE" || return
  stopped=no
  sleep 8
  systemctl is-active --quiet "$SERVICE" && [[ $(systemctl show -p NRestarts --value "$SERVICE") == 0 ]]
}

switch_to() { # switch_to NAME: current becomes previous; a service that does not stay up is taken back
  local name=$1 before
  before=$(named current)
  [[ $before != "$name" ]] || before=''
  point current "$name"
  if start_service; then
    if [[ -n $before ]]; then point previous "$before"; fi
    say "release $name is current${before:+ (before: $before)}"
  elif [[ -n $before ]]; then
    point current "$before"
    start_service || say "the release before does not stay up either"
    give_up "release $name does not stay up; $before is current again. See: journalctl -u $SERVICE"
  else
    give_up "release $name does not stay up. See: journalctl -u $SERVICE"
  fi
}

# --- actions

list_releases() {
  local folder name
  for folder in "$prefix"/releases/*/; do
    [[ -f $folder/complete ]] || continue
    name=$(basename "$folder")
    case $name in
      "$(named current)") echo "$name  current" ;;
      "$(named previous)") echo "$name  previous" ;;
      *) echo "$name" ;;
    esac
  done
}

go_back() {
  local name=${release:-$(named previous)}
  [[ -n $name ]] || refuse "there is no previous release; see: $0 --list"
  [[ -f $prefix/releases/$name/complete ]] || refuse "release $name is not installed; see: $0 --list"
  switch_to "$name"
}

install_release() {
  [[ -n $wheel ]] || { usage >&2; refuse "no wheel is given"; }
  [[ -f $wheel && $wheel == *.whl ]] || refuse "$wheel is not a wheel"
  wheel=$(cd "$(dirname "$wheel")" && pwd)/$(basename "$wheel")
  if [[ -z $release ]]; then
    release=$(basename "$wheel")
    release=${release#*-}
    release=${release%%-*}
  fi
  [[ $release =~ ^[A-Za-z0-9][A-Za-z0-9._+-]*$ ]] || refuse "'$release' cannot be the name of a release"
  local folder=$prefix/releases/$release address before
  before=$(named current)
  [[ ! -f $folder/complete ]] ||
    refuse "release $release is installed already; give this one another name with --release, or go to it with --back"

  if [[ ! -f $config ]]; then
    install -D -m 0644 "$here/node.toml.example" "$config"
    refuse "wrote $config from the example: set rig, id and controller in it, then run this again"
  fi

  if on_this_machine; then packages; account; else mkdir -p "$state"; fi
  build "$folder" || { rm -rf "$folder"; give_up "release $release could not be built; nothing has changed"; }

  address=$(controller_address "$folder/venv") || { rm -rf "$folder"; exit 2; }
  settle "$address"

  if [[ $checked == yes ]]; then
    stop_service # the camera serves one process at a time
    if ! as_service_user "$folder/venv/bin/ringdic-node" check --config "$config"; then
      rm -rf "$folder"
      give_up "release $release does not pass its check and is removed; ${before:-no release} is current"
    fi
  fi
  switch_to "$release"
}

case $action in
  install) install_release ;;
  back) go_back ;;
  list) list_releases ;;
esac
