// Writes the points of the self-test. Call: hard_points_generator OUTPUT

#include <fstream>
#include <iostream>
#include <string>

#include "tests/numerics/hard_points.h"
#include "tests/support.h"

int main(int argc, char** argv) {
    using namespace brdfit;
    if (argc != 2) {
        std::cerr << "usage: hard_points_generator OUTPUT\n";
        return 2;
    }
    std::string table = "// Generated: build/tests/hard_points_generator kernels/hard_points.inc\n";
    for (const kernels::Model* model : tests::variants())
        for (kernels::HardPoint& point : tests::choose_hard_points(*model)) {
            tests::refer(*model, point);
            table += tests::text_of(*model, point);
        }
    std::ofstream out(argv[1]);  // at the end: an error leaves the table as it was
    return (out << table).flush() ? 0 : 1;
}
