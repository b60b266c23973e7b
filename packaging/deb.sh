#!/usr/bin/env bash
# Makes a Debian package of a built program: deb.sh BINARY ARCHITECTURE VERSION DOCUMENTS SOURCE OUTPUT
#
# DOCUMENTS is a folder with man/, completions/, and the inventory as echolake.cdx.json; SOURCE the release's sources
# with the licences in python/. $DEBFULLNAME and $DEBEMAIL name the maintainer, as for other tools of Debian. The archive
# is the same, byte for byte, for the same input and $SOURCE_DATE_EPOCH.
set -euo pipefail
[ "$#" -eq 6 ] || { sed -n '2,6s/^# //p' "$0"; exit 2; }
binary=$1 architecture=$2 version=$3 documents=$4 source=$5 output=$6
maintainer="${DEBFULLNAME:-the echolake authors} <${DEBEMAIL:-echolake@localhost}>"
packaging=$(cd "$(dirname "$0")" && pwd)

# All that it may link is in libc6, which the package depends on.
foreign=$(readelf -d "$binary" | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' | grep -vE '^(lib(c|m|dl|rt|pthread|util)\.so|ld-linux)' || true)
[ -z "$foreign" ] || { echo "error: $binary needs $foreign, which is not in libc6" >&2; exit 1; }

root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
chmod 755 "$root"
install -D -m 755 "$binary" "$root/usr/bin/echolake"
for unit in "$packaging"/debian/*.{service,timer}; do
    install -D -m 644 "$unit" "$root/usr/lib/systemd/system/$(basename "$unit")"
done
install -D -m 755 "$packaging/debian/backup" "$root/usr/lib/echolake/backup"
install -D -m 644 "$packaging/debian/echolake.default" "$root/etc/default/echolake"
for page in "$documents"/man/*.1; do
    install -D -m 644 "$page" "$root/usr/share/man/man1/$(basename "$page")"
done
install -D -m 644 "$documents/completions/echolake.bash" "$root/usr/share/bash-completion/completions/echolake"
install -D -m 644 "$documents/completions/echolake.zsh" "$root/usr/share/zsh/vendor-completions/_echolake"
install -D -m 644 "$documents/completions/echolake.fish" "$root/usr/share/fish/vendor_completions.d/echolake.fish"
doc=$root/usr/share/doc/echolake
install -d "$doc"
install -m 644 "$source"/{README,CHANGELOG}.md "$source/docs/"*.md "$source/python/THIRD-PARTY-LICENCES.txt" \
    "$documents/echolake.cdx.json" "$doc"
install -D -m 644 -t "$doc/grafana" "$source"/docs/grafana/*
date=$(date -R -u -d "@${SOURCE_DATE_EPOCH:-$(date +%s)}")
printf 'echolake (%s) stable; urgency=medium\n\n  * See CHANGELOG.md.gz.\n\n -- %s  %s\n' \
    "$version" "$maintainer" "$date" > "$doc/changelog"
{
    cat "$source/LICENSE-MIT"
    printf '\nOr, at your choice, the Apache License, Version 2.0: /usr/share/common-licenses/Apache-2.0\n\n'
    printf 'What is compiled in, with its licences: /usr/share/doc/echolake/THIRD-PARTY-LICENCES.txt.gz\n'
} > "$doc/copyright"
chmod 644 "$doc"/{changelog,copyright}
gzip -9n "$root"/usr/share/man/man1/*.1 "$doc"/{changelog,echolake.cdx.json,THIRD-PARTY-LICENCES.txt} "$doc"/*.md

mkdir -m 755 "$root/DEBIAN"
install -m 755 "$packaging"/debian/{postinst,prerm,postrm} "$root/DEBIAN"
echo /etc/default/echolake > "$root/DEBIAN/conffiles"
size=$(du -sk --apparent-size --exclude=DEBIAN "$root" | cut -f1)
sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$architecture/" -e "s/@SIZE@/$size/" \
    -e "s/@MAINTAINER@/$maintainer/" "$packaging/debian/control" > "$root/DEBIAN/control"
(cd "$root" && find usr -type f -print0 | sort -z | xargs -0 md5sum) > "$root/DEBIAN/md5sums"
chmod 644 "$root"/DEBIAN/{control,conffiles,md5sums}
dpkg-deb --root-owner-group -Zxz --build "$root" "$output/echolake_${version}_$architecture.deb"
