#!/usr/bin/python3
"""Compares brdfit's losses with those that scipy_multistart.py found.

    compare.py PROGRAM JUDGED.json FILE.csv [...]      (pairs of a judge's output and its measurements)

Prints ours/theirs for each channel and model; exit 1 if one of ours is more than 1e-3 above theirs.
"""
import csv
import json
import subprocess
import sys
import tempfile


def request(path):
    """The CSV as a JSON request: every model, Lafortune with one and with two lobes."""
    channels = {}
    with open(path, encoding="utf-8") as handle:
        for row in csv.DictReader(line for line in handle if not line.startswith("#")):
            wavelength = row.get("wavelength_nm")
            name = row.get("channel") or (f"{float(wavelength):g}nm" if wavelength else "1")
            channel = channels.setdefault(name, {"name": name, "scans": {}})
            if wavelength:
                channel["wavelength_nm"] = float(wavelength)
            scan = channel["scans"].setdefault(row["theta_i_deg"], {"theta_i_deg": float(row["theta_i_deg"]),
                                                                    "theta_r_deg": [], "brdf": []})
            scan["theta_r_deg"].append(float(row["theta_r_deg"]))
            scan["brdf"].append(float(row["brdf_per_sr"]))
    for channel in channels.values():
        channel["scans"] = list(channel["scans"].values())
    models = ["phong", "ward", {"name": "lafortune", "lobes": 1}, {"name": "lafortune", "lobes": 2}, "he_torrance"]
    return {"dataset": {"channels": list(channels.values())}, "models": models}


def main():
    program, pairs = sys.argv[1], list(zip(sys.argv[2::2], sys.argv[3::2]))
    worse = compared = 0
    for judged, measured in pairs:
        with tempfile.NamedTemporaryFile("w", suffix=".json") as handle:
            json.dump(request(measured), handle)
            handle.flush()
            answer = json.loads(subprocess.run([program, "fit", handle.name, "--json"], check=True, capture_output=True,
                                               text=True).stdout)
        with open(judged, encoding="utf-8") as handle:
            theirs = json.load(handle)["channels"]
        for channel in answer["channels"]:
            for fit in channel["fits"]:
                name = fit["model"] + (f"_{fit['lobes']}" if "lobes" in fit else "")
                best = theirs.get(channel["name"], {}).get(name)
                if best is None:
                    continue
                ratio = fit["loss"] / best["loss"]
                compared += 1
                worse += ratio > 1.001
                print(f"{measured.rsplit('/', 1)[-1]:42} {channel['name']:6} {name:12} {fit['loss']:.9g} / "
                      f"{best['loss']:.9g} = {ratio:.9f}  {fit['search']['agreed']}/{fit['search']['starts']}")
    print(f"{compared} compared, {worse} more than 1e-3 above")
    return 1 if worse or not compared else 0


if __name__ == "__main__":
    sys.exit(main())
