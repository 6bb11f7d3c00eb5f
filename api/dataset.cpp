#include "api/dataset.h"

#include <cmath>
#include <set>

#include "api/names.h"
#include "api/samples.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using optim::Channel;
using optim::Dataset;
using optim::Sample;

/// Columns of a scan or of free samples, before they become samples.
struct Columns {
    std::optional<double> scan_theta_i;
    std::vector<double> theta_i, phi_i, theta_r, phi_r, brdf, sigma;
    bool has_phi_i = false;
    bool has_sigma = false;
};

Field<Columns> column_field(std::string_view key, bool required, std::string_view doc,
                            std::vector<double> Columns::*column, const Rule& bad) {
    return {key, required, doc, schema::array(schema::number(bad), 1, kMostSamples),
            [=](const json& v, const Place& p, Columns& out) { out.*column = read_column(v, p, bad); }};
}

Field<Columns> sigma_field() {
    return {"sigma", false, "standard deviation of brdf, same unit",
            schema::array(schema::number(bad_sigma), 1, kMostSamples), [](const json& v, const Place& p, Columns& out) {
                out.sigma = read_column(v, p, bad_sigma);
                out.has_sigma = true;
            }};
}

const std::vector<Field<Columns>> kScanFields{
    {"theta_i_deg", true, "incidence angle", schema::number(bad_theta_i),
     [](const json& v, const Place& p, Columns& out) { out.scan_theta_i = read_checked(v, p, bad_theta_i); }},
    column_field("theta_r_deg", true, "exitant angles, signed: positive = specular side", &Columns::theta_r,
                 bad_theta_r),
    column_field("brdf", true, "BRDF values", &Columns::brdf, bad_brdf),
    sigma_field(),
};

const std::vector<Field<Columns>> kSamplesFields{
    column_field("theta_i_deg", true, "incidence angles", &Columns::theta_i, bad_theta_i),
    {"phi_i_deg", false, "azimuths of incidence; 0 if absent", schema::array(schema::number(bad_phi), 1, kMostSamples),
     [](const json& v, const Place& p, Columns& out) {
         out.phi_i = read_column(v, p, bad_phi);
         out.has_phi_i = true;
     }},
    column_field("theta_r_deg", true, "exitant angles; if one is negative, signs count and must agree with phi",
                 &Columns::theta_r, bad_theta_r),
    column_field("phi_r_deg", true, "exitant azimuths: phi_r - phi_i = 180 is the specular side", &Columns::phi_r,
                 bad_phi),
    column_field("brdf", true, "BRDF values", &Columns::brdf, bad_brdf),
    sigma_field(),
};

void append_scan(const json& value, const Place& place, Channel& out) {
    Columns columns;
    read_object<Columns>(value, place, kScanFields, columns);
    const std::size_t n = columns.theta_r.size();
    if (!value.is_object() || !value.contains("brdf") || !value.contains("theta_r_deg")) return;
    if (n == 0) place.at("theta_r_deg").fail("empty", "must have at least one element");
    bool whole = same_length(place, "brdf", columns.brdf.size(), n);
    if (columns.has_sigma) whole = same_length(place, "sigma", columns.sigma.size(), n) && whole;
    if (!whole || !columns.scan_theta_i) return;
    for (std::size_t j = 0; j < n; ++j) {
        Sample sample{{*columns.scan_theta_i, columns.theta_r[j], 0}, columns.brdf[j], {}};
        if (columns.has_sigma) sample.sigma = columns.sigma[j];
        out.samples.push_back(sample);
    }
}

void append_samples(const json& value, const Place& place, Channel& out) {
    Columns columns;
    read_object<Columns>(value, place, kSamplesFields, columns);
    if (!value.is_object() || !value.contains("theta_r_deg")) return;
    const std::size_t n = columns.theta_r.size();
    if (n == 0) place.at("theta_r_deg").fail("empty", "must have at least one element");
    bool whole = true;
    for (const auto& [key, column] :
         {std::pair{"theta_i_deg", &columns.theta_i}, std::pair{"phi_i_deg", &columns.phi_i},
          std::pair{"phi_r_deg", &columns.phi_r}, std::pair{"brdf", &columns.brdf}, std::pair{"sigma", &columns.sigma}})
        if (value.contains(key)) whole = same_length(place, key, column->size(), n) && whole;
        else if (std::string_view(key) != "phi_i_deg" && std::string_view(key) != "sigma") whole = false;
    if (!whole) return;
    const bool has_sign = std::any_of(columns.theta_r.begin(), columns.theta_r.end(), [](double t) { return t < 0; });
    for (std::size_t j = 0; j < n; ++j) {
        const auto direction =
            direction_of(columns.theta_i[j], columns.theta_r[j], columns.has_phi_i ? columns.phi_i[j] : 0.0,
                         columns.phi_r[j], has_sign ? Signs::meaningful : Signs::absent);
        if (!direction) {
            place.at("theta_r_deg")
                .at(j)
                .fail("contradiction",
                      "the sign (positive = specular side) contradicts phi_r - phi_i "
                      "(180 = specular side)");
            continue;
        }
        Sample sample{*direction, columns.brdf[j], {}};
        if (columns.has_sigma) sample.sigma = columns.sigma[j];
        out.samples.push_back(sample);
    }
}

const std::vector<Field<Channel>> kChannelFields{
    {"name", false, "name; the wavelength or the position if absent", schema::name(),
     [](const json& v, const Place& p, Channel& out) { out.name = read_text(v, p).value_or(""); }},
    {"wavelength_nm", false, "wavelength", schema::number(bad_wavelength),
     [](const json& v, const Place& p, Channel& out) { out.wavelength_nm = read_checked(v, p, bad_wavelength); }},
    {"scans", false, "scans in the plane of incidence; a channel has these or samples, or both",
     schema::array(schema_of(kScanFields)),
     [](const json& v, const Place& p, Channel& out) {
         if (!v.is_array()) return p.fail("wrong_type", "must be an array");
         for (std::size_t i = 0; i < v.size(); ++i) append_scan(v[i], p.at(i), out);
     }},
    {"samples", false, "samples in any direction, as columns of equal length", schema_of(kSamplesFields),
     append_samples},
};

void read_channels(const json& value, const Place& place, Dataset& out) {
    if (!value.is_array() || value.empty() || value.size() > kMostChannels) {
        place.fail("wrong_type", "must be an array of 1 to " + std::to_string(kMostChannels) + " channels");
        return;
    }
    std::set<std::string> names;
    std::size_t samples = 0;
    for (std::size_t i = 0; i < value.size(); ++i) {
        Channel channel;
        read_object<Channel>(value[i], place.at(i), kChannelFields, channel);
        if (channel.samples.empty() && value[i].is_object() && !value[i].contains("scans") &&
            !value[i].contains("samples"))
            place.at(i).fail("missing", "must have scans or samples");
        if (channel.name.empty())
            channel.name = channel.wavelength_nm ? wavelength_name(*channel.wavelength_nm) : std::to_string(i + 1);
        if (!names.insert(channel.name).second)
            place.at(i).at("name").fail("duplicate", "a channel of that name stands before");
        samples += channel.samples.size();
        if (samples > kMostSamples) {
            place.at(i).fail("too_many", "at most " + std::to_string(kMostSamples) + " samples in a request");
            return;
        }
        out.channels.push_back(std::move(channel));
    }
}

/// phi_r of a canonical direction where phi_i is 0 and theta_r has no sign.
double azimuth_on_wire(const kernels::Direction& direction) {
    return 180 + (direction.theta_r_deg < 0 ? 180 - direction.phi_deg : direction.phi_deg);
}

/// A sample in the plane of incidence, into the scan before it where it continues that one.
void append_scan_sample(json& scans, const Sample& sample) {
    const bool continues = !scans.empty() && scans.back()["theta_i_deg"] == sample.direction.theta_i_deg &&
                           scans.back().contains("sigma") == sample.sigma.has_value();
    if (!continues) scans.push_back({{"theta_i_deg", sample.direction.theta_i_deg}});
    json& scan = scans.back();
    scan["theta_r_deg"].push_back(sample.direction.theta_r_deg);
    scan["brdf"].push_back(sample.brdf);
    if (sample.sigma) scan["sigma"].push_back(*sample.sigma);
}

}  // namespace

const std::vector<Field<Dataset>>& dataset_fields() {
    static const std::vector<Field<Dataset>> fields{
        {"name", false, "of the surface", schema::name(),
         [](const json& v, const Place& p, Dataset& out) { out.name = read_text(v, p).value_or(""); }},
        {"unit", false, "of all BRDF values",
         schema::with_default(schema::choice(kUnits), name_of(kUnits, Dataset{}.unit)),
         [](const json& v, const Place& p, Dataset& out) {
             if (const auto unit = read_choice(v, p, kUnits)) out.unit = *unit;
         }},
        {"channels", true, "wavelengths or colours", schema::array(schema_of(kChannelFields), 1, kMostChannels),
         read_channels},
    };
    return fields;
}

std::string canonical_text(const Dataset& dataset) {
    json channels = json::array();
    for (const Channel& channel : dataset.channels) {
        json entry{{"name", channel.name}};
        if (channel.wavelength_nm) entry["wavelength_nm"] = *channel.wavelength_nm;
        json scans = json::array();
        json samples = json::object();
        for (const Sample& sample : channel.samples) {
            const double phi_r = azimuth_on_wire(sample.direction);
            // What reading will make of it: rounded once, and the same ever after.
            const Sample kept{*direction_of(sample.direction.theta_i_deg, std::abs(sample.direction.theta_r_deg), 0,
                                            phi_r, Signs::absent),
                              sample.brdf, sample.sigma};
            if (sample.direction.phi_deg == 0) append_scan_sample(scans, sample);
            else if (kept.direction.phi_deg == 0) append_scan_sample(scans, kept);
            else {
                samples["theta_i_deg"].push_back(kept.direction.theta_i_deg);
                samples["theta_r_deg"].push_back(std::abs(kept.direction.theta_r_deg));
                samples["phi_r_deg"].push_back(phi_r);
                samples["brdf"].push_back(kept.brdf);
                if (kept.sigma) samples["sigma"].push_back(*kept.sigma);
            }
        }
        if (!scans.empty()) entry["scans"] = std::move(scans);
        if (!samples.empty()) entry["samples"] = std::move(samples);
        channels.push_back(std::move(entry));
    }
    return json{{"name", dataset.name}, {"unit", name_of(kUnits, dataset.unit)}, {"channels", channels}}.dump();
}

}  // namespace brdfit::api
