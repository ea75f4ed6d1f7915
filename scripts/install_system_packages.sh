#!/bin/sh
# Installs Debian packages if that needs no question; else says what to do.
# Usage: install_system_packages.sh WHY PACKAGE...
why=$1
shift
if ! command -v apt-get > /dev/null; then
  echo "$why: install the equivalent of the Debian packages $*" >&2
  exit 2
elif [ "$(id -u)" = 0 ]; then
  as_root=
elif sudo -n true 2> /dev/null; then
  as_root="sudo -n"
else
  echo "$why: run sudo apt-get install $*, then this again" >&2
  exit 2
fi
echo "$why: installing $*"
$as_root apt-get update -qq &&
  $as_root env DEBIAN_FRONTEND=noninteractive \
    apt-get install -qq --no-install-recommends "$@" > /dev/null
