#include "api/progress.h"

#include <cmath>

#include <nlohmann/json.hpp>

#include "api/json.h"

namespace brdfit::api {
namespace {

using Json = nlohmann::ordered_json;

constexpr std::size_t kMostTold = 100;

Json task_json(const optim::Progress::Task& task) {
    Json json{{"channel", task.channel}, {"model", task.model}};
    json["relative_loss"] =
        task.relative_loss && std::isfinite(*task.relative_loss) ? Json(*task.relative_loss) : Json();
    return json;
}

}  // namespace

std::string progress_json(const std::vector<optim::Progress::Task>& tasks, double evaluations_per_s) {
    double fraction = 0;
    std::size_t done = 0;
    std::size_t evaluations = 0;
    for (const optim::Progress::Task& task : tasks) {
        fraction += task.fraction / static_cast<double>(tasks.size());
        done += task.done ? 1 : 0;
        evaluations += task.evaluations;
    }
    Json best = Json::array();
    for (const bool ended : {false, true})
        for (const optim::Progress::Task& task : tasks)
            if (task.done == ended && task.relative_loss && best.size() < kMostTold) {
                best.push_back(task_json(task));
                best.back()["done"] = task.done;
            }
    return text_of({{"fraction", std::round(1000 * fraction) / 1000},
                    {"models_done", done},
                    {"models", tasks.size()},
                    {"evaluations", evaluations},
                    {"evaluations_per_s", std::round(evaluations_per_s)},
                    {"best", best}});
}

std::string model_done_json(const optim::Progress::Task& task) { return text_of(task_json(task)); }

}  // namespace brdfit::api
