#!/usr/bin/env bash
# The Debian package in a system of its own: installs, starts by its unit's command, answers, is removed, leaves nothing.
# Needs root, debootstrap and a Debian mirror: ./test --package. Downloads about 400 MB.
. "$(dirname "${BASH_SOURCE[0]}")/../http/lib.sh"
((EUID == 0)) || { fail "the package can be tried" "it needs root"; finish; }
build=${BRDFIT_BUILD:-$repository/build}
root=$work/root
mounted=()
leave() {
    local folder
    [[ -z ${service-} ]] || kill -KILL "$service" 2>/dev/null
    for folder in "${mounted[@]+"${mounted[@]}"}"; do
        umount -l "$folder" || work=$work/nothing # what is still mounted must not be deleted
    done
    stop_servers
}
trap leave EXIT

check "cpack" cpack -G DEB --config "$build/CPackConfig.cmake" -B "$work/package"
package=$(echo "$work"/package/*.deb)
check "its fields" grep -q 'Depends: .*pocl-opencl-icd.*libprometheus\|Depends: .*libprometheus.*pocl-opencl-icd\|Depends: .*libnlopt' \
    <(dpkg-deb -f "$package" | sed -n '/^Depends/p')
check_equal "its configuration file" "$(dpkg-deb --ctrl-tarfile "$package" | tar -xO ./conffiles)" /etc/default/brdfit
check "systemd takes the unit" bash -c 'out=$(systemd-analyze verify --man=no "$1" 2>&1); ! grep -v "is not executable" <<<"$out" | grep .' \
    - "$repository/deploy/brdfit.service"

# ---- a system ----
if [[ -d ${BRDFIT_ROOT-} ]]; then cp -a "$BRDFIT_ROOT" "$root"
else check "debootstrap" debootstrap --variant=minbase bookworm "$root" http://deb.debian.org/debian || finish; fi
cp /etc/resolv.conf "$root/etc/"
for folder in proc dev sys; do
    if mount --bind "/$folder" "$root/$folder"; then mounted+=("$root/$folder"); fi
done
printf '#!/bin/sh\nexit 101\n' >"$root/usr/sbin/policy-rc.d"
chmod +x "$root/usr/sbin/policy-rc.d"
inside() { chroot "$root" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive LC_ALL=C "$@"; }
check "apt-get update" inside apt-get -q update
check "what it depends on" inside apt-get -q -y install --no-install-recommends adduser pocl-opencl-icd
names() { (cd "$root" && find . -xdev \( -path ./proc -o -path ./dev -o -path ./sys -o -path ./tmp \) -prune -o -iname '*brdfit*' -print | sort); }
users() { cat "$root/etc/passwd" "$root/etc/group" "$root/etc/shadow"; }
check_equal "nothing of it is there before" "$(names)" ""
users >"$work/users"

# ---- installed ----
cp "$package" "$root/tmp/brdfit.deb"
check "apt-get install" inside apt-get -q -y install --no-install-recommends /tmp/brdfit.deb
check_equal "whose folders" "$(inside stat -c '%U %a' /var/lib/brdfit /var/cache/brdfit | sort -u)" "brdfit 700"
unit=$root/usr/lib/systemd/system/brdfit.service
command=$(sed -n 's/^ExecStart=//p' "$unit")
mapfile -t environment < <(sed -n 's/^Environment=//p' "$unit" | tr ' ' '\n')
# Port 0 takes a free one; all else is as the unit and its options say.
sed -i 's/--port 8080/--port 0/' "$root/etc/default/brdfit"
chroot --userspec=brdfit:brdfit "$root" env -i PATH=/usr/bin:/bin "${environment[@]}" \
    sh -c ". /etc/default/brdfit; exec $command" >"$work/service.log" 2>&1 &
service=$!
for _ in {1..1200}; do
    url=$(sed -n 's|.* listens on \(http://127\.0\.0\.1:[0-9]*\).*|\1|p' "$work/service.log")
    [[ -z $url ]] && kill -0 $service 2>/dev/null || break
    sleep 0.1
done
check "it starts" test -n "$url" || cat "$work/service.log"
get /health/live
answered "live" 200
get /health/ready
answered "ready" 200
post_csv models=ward,lambert "$samples/white_plastic.csv"
answered "it fits" 200
check "it keeps compiled kernels" test -n "$(ls "$root/var/cache/brdfit")"
check_equal "it runs as its user" "$(ps -o uid= -p "$service" | xargs)" "$(inside id -u brdfit)"
kill -TERM $service
status=none
wait_for_end $service 20
check_equal "it stops" "$status" 0
service=

# ---- removed ----
check "remove" inside apt-get -q -y remove brdfit
check "results and options stay" test -d "$root/var/lib/brdfit" -a -f "$root/etc/default/brdfit"
check "purge" inside apt-get -q -y purge brdfit
rm -f "$root/tmp/brdfit.deb"
check_equal "nothing is left" "$(names | grep -v '/var/cache/apt/')" ""
check "... nor the user" diff "$work/users" <(users)
finish
