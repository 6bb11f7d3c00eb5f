#include "api/examples.h"

namespace brdfit::api::examples {

using schema::Json;

Json dataset() {
    return Json::parse(R"({"name": "white plastic", "unit": "1/sr", "channels": [
        {"name": "550nm", "wavelength_nm": 550, "scans": [
            {"theta_i_deg": 15, "theta_r_deg": [-60, 0, 10, 15, 20, 60], "brdf": [0.17, 0.25, 0.31, 0.33, 0.31, 0.17]},
            {"theta_i_deg": 60, "theta_r_deg": [-60, 0, 50, 60, 70, 80], "brdf": [0.17, 0.17, 0.71, 1.5, 2.1, 1.8]}]}]})");
}

Json fit_request() {
    Json request = Json::parse(R"({"dataset": null,
        "models": ["ward", {"name": "lafortune", "lobes": 1, "bounds": {"n_1": [1, 500]}}],
        "options": {"loss": "cosine_l2", "effort": "draft", "seed": 1, "time_limit_s": 30}})");
    request["dataset"] = dataset();
    return request;
}

Json evaluate_request() {
    return Json::parse(R"({"model": "ward", "parameters": {"rho_d": 0.3, "rho_s": 0.1, "alpha": 0.15},
        "wavelength_nm": 550, "precision": "auto", "gradient": true,
        "geometry": {"theta_i_deg": [30, 30], "theta_r_deg": [30, -20], "phi_deg": [0, 0]}})");
}

}  // namespace brdfit::api::examples
