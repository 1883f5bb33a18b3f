#!/bin/sh
# Make a Debian 13 with Wine, Xvfb and MinGW in CACHE/root, two to ten minutes the first time. Needs root.
# Packages come from the mirror of this computer's apt, with its settings.
set -eu
cache=$1 root=$1/root
if [ "$(id -u)" != 0 ]; then
    echo "make windows needs root, for a Debian in a folder and its mounts: sudo make windows" >&2; exit 1
fi
if [ -e "$root/ready" ]; then exit 0; fi
export DEBIAN_FRONTEND=noninteractive DEBCONF_NOWARNINGS=yes
if ! command -v debootstrap >/dev/null; then
    apt-get update -qq; apt-get install --no-install-recommends --yes debootstrap debian-archive-keyring >/dev/null
fi
mirror=$(apt-get indextargets --format '$(SITE)' 'Created-By: Packages' | grep '/debian/*$' | head -n 1)
echo 'making a Debian with Wine in a folder'
rm -rf "$root"; mkdir -p "$cache/win"
debootstrap --variant=minbase --include=ca-certificates trixie "$root" "$mirror" >"$cache/root.log" 2>&1
cp /etc/apt/apt.conf.d/* "$root/etc/apt/apt.conf.d/"
chroot "$root" sh -c 'apt-get update -qq && apt-get install --no-install-recommends --yes \
    wine wine64 xvfb xauth gcc-mingw-w64-x86-64-win32' >>"$cache/root.log" 2>&1
touch "$root/ready"
