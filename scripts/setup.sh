# What ./run and ./test share. Sourced in the repository's root; logs go to the folder $out.
# shellcheck shell=bash disable=SC2154

say() { printf '%s\n' "$@"; }
die() { printf '%s: %s\n' "${0##*/}" "$*" >&2; exit 1; }

# Names in a group of packages.txt.
packages_of() {
    local group
    for group; do
        sed -n "/^\[$group\]/,/^\[/{/^\[/d;s/#.*//;s/[[:space:]]*$//;/./p}" packages.txt
    done
}

# Installs the packages of these groups that are missing; asks for nothing where none is.
install_packages() {
    local missing as_root=()
    command -v apt-get dpkg-query >/dev/null || die "this needs Debian's apt-get; install what packages.txt lists by hand"
    # shellcheck disable=SC2046 # a list of words
    mapfile -t missing < <(comm -23 <(packages_of "$@" | sort) \
        <(dpkg-query -W -f '${db:Status-Status} ${Package}\n' $(packages_of "$@") 2>/dev/null | sed -n 's/^installed //p' | sort))
    ((${#missing[@]})) || return 0
    say "Installing ${missing[*]}"
    if ((EUID != 0)); then
        command -v sudo >/dev/null || die "installing packages needs root, or sudo"
        as_root=(sudo)
    fi
    "${as_root[@]}" apt-get update -qq >"$out/install.log" 2>&1 || say "apt-get update failed; trying with what it knows"
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" \
        >>"$out/install.log" 2>&1 || { tail -n 20 "$out/install.log" >&2; die "apt-get install failed; $out/install.log"; }
}

# The folder that a preset of CMakePresets.json builds in.
build_folder() { [[ $1 == release ]] && echo build || echo "build-$1"; }

# configure PRESET [cmake option...]
configure() {
    local log=$out/configure-$1.log
    cmake --preset "$@" >"$log" 2>&1 || { tail -n 30 "$log" >&2; die "cmake failed; $log"; }
}

# compile PRESET [target...]: what is not up to date.
compile() {
    local folder
    folder=$(build_folder "$1")
    shift
    cmake --build "$folder" ${1+--target "$@"} || die "the build failed"
}

# wait_for_server PID LOG SECONDS: prints the URL that a server started by us has written to its log, once it answers
# there. It does so when the kernels of one precision are built: fits are possible at once. False if it ended, or took too long.
wait_for_server() {
    local pid=$1 log=$2 seconds=$3 url
    local end=$((SECONDS + seconds))
    while ((SECONDS < end)); do
        url=$(sed -n 's|.* listens on \(http://[^, ]*\).*|\1|p' "$log")
        if [[ -n $url ]] && curl -fsS -m 2 -o /dev/null "$url/health/live" 2>/dev/null; then
            printf '%s\n' "$url"
            return 0
        fi
        kill -0 "$pid" 2>/dev/null || return 1
        sleep 0.05
    done
    return 1
}

# Asks the process to end, waits up to 10 s, then ends it; returns its status where it is a child.
stop_server() {
    local pid=$1 end=$((SECONDS + 10))
    kill -TERM "$pid" 2>/dev/null
    while kill -0 "$pid" 2>/dev/null; do
        ((SECONDS < end)) || kill -KILL "$pid" 2>/dev/null
        sleep 0.05
    done
    wait "$pid" 2>/dev/null
}
