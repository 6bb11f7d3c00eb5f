#!/usr/bin/env bash
# Measured surfaces, where they lie beside the repository: every model comes back for every channel.
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
finish
