#!/bin/sh
# Run a command in the Wine root, as `wine.sh CACHE wine PROGRAM ARGUMENT...`. Needs root.
# Z:\win is CACHE/win and Z:\checkout this checkout. What the command has started ends with it.
set -eu
cache=$1; checkout=$(cd "$(dirname "$0")/../.." && pwd); shift
exec unshare --mount --pid --fork --kill-child sh -eu -c '
    root=$1/root win=$1/win checkout=$2 prefix=$3 debug=$4; shift 4
    mkdir -p "$root/win" "$root/checkout"
    mount --make-rprivate /
    mount -t proc proc "$root/proc"; mount --rbind /dev "$root/dev"; mount --bind /sys "$root/sys"
    mount -t tmpfs tmpfs "$root/tmp"
    mount --bind "$win" "$root/win"; mount --bind "$checkout" "$root/checkout"
    exec chroot "$root" /usr/bin/env -i PATH=/usr/bin:/bin HOME=/root LANG=C.UTF-8 TZ=UTC XDG_RUNTIME_DIR=/tmp \
        WINEARCH=win64 WINEPREFIX="$prefix" WINEDEBUG="$debug" "$@"
' sh "$cache" "$checkout" "${WINEPREFIX:-/win/prefix}" "${WINEDEBUG:--all}" "$@"
