// Writes the counts of operations. Call: operation_counts_generator OUTPUT

#include <fstream>
#include <iostream>

#include "tests/numerics/operation_counts.h"

int main(int argc, char** argv) {
    if (argc != 2) {
        std::cerr << "usage: operation_counts_generator OUTPUT\n";
        return 2;
    }
    const std::string table = brdfit::tests::operation_counts_table();
    std::ofstream out(argv[1]);  // at the end: an error leaves the table as it was
    return (out << table).flush() ? 0 : 1;
}
