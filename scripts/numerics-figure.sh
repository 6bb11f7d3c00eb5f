#!/usr/bin/env bash
# Draws docs/figures/numerics-error.svg: the worst error of every kernel over its domain. Takes some minutes.
# usage: scripts/numerics-figure.sh [POINTS]    random points to a model and precision, 50000 without
set -u
export LC_ALL=C.UTF-8
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
readonly out=out
. scripts/setup.sh

mkdir -p $out || exit 1
install_packages run test docs
configure release -DBRDFIT_TESTS=ON
compile release error_map
say "Measuring"
build/tests/error_map $out/numerics-error.csv "${1-50000}" || die "error_map failed"
gnuplot -e "data='$out/numerics-error.csv'; picture='$out/numerics-error.svg'" docs/figures/numerics-error.gp ||
    die "gnuplot failed"
# Bins are squares, not a smooth picture.
sed "s/<image /<image image-rendering='optimizeSpeed' style='image-rendering:pixelated' /" $out/numerics-error.svg \
    >docs/figures/numerics-error.svg
say docs/figures/numerics-error.svg
