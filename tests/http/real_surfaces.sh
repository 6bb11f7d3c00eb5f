#!/usr/bin/env bash
# Measured surfaces, where they lie beside the repository: every model comes back for every channel, and what is
# recommended for a scene is right.
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
folder=$repository/../shared/data/real
if ! compgen -G "$folder/*.csv" >/dev/null; then
    echo "real surfaces: folder absent, skipped"
    finish
fi
require_server
for file in "$folder"/*.csv; do
    name=$(basename "$file" .csv)
    post_csv "name=$name" "$file"
    answered "$name" 200 || continue
    holds "$name: all models for each channel" 'all(.channels[]; .failures == []
        and ([.fits[].model] | sort == ["he_torrance", "lafortune", "lambert", "phong", "ward"]))'
    holds "$name: every sample is in a channel" '([.channels[].samples] | add) == $rows' \
        --argjson rows "$(($(grep -vc '^#' "$file") - 1))"
    holds "$name: fits are ranked" 'all(.channels[]; ([.fits[].loss] | . == sort) and [.fits[].rank] == [1, 2, 3, 4, 5])'
    holds "$name: a model with a lobe is no worse than none" \
        'all(.channels[]; [.fits[] | {(.model): .loss}] | add | .phong <= .lambert and .ward <= .lambert)'
    holds "$name: the best leaves less than half of the signal" 'all(.channels[]; .fits[0].relative_loss < 0.5)'
done
# What is recommended for scenes, by models, errors and albedos of another make; Debian's python has SciPy.
if ! /usr/bin/python3 -c 'import scipy' 2>/dev/null; then
    echo "scenes of real surfaces: no python3-scipy, skipped"
    finish
fi
/usr/bin/python3 "$(dirname "${BASH_SOURCE[0]}")/scenes.py" "$url" "$folder"/*.csv >"$work/scenes" 2>&1
check_equal "scenes of real surfaces" "$?" 0
[[ ${BRDFIT_LONG-} != 1 ]] && grep -q 'NOT SO\|Error' "$work/scenes" && cat "$work/scenes"
tail -n 1 "$work/scenes"
finish
