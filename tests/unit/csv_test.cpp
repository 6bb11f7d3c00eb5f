/// Measurements as comma-separated values.
#include "api/csv.h"

#include <string>

#include <gtest/gtest.h>

#include "tests/unit/refused.h"

namespace brdfit::api {
namespace {

using optim::Channel;
using optim::Dataset;
using optim::Sample;

const std::string kHead = "theta_i_deg,theta_r_deg,brdf_per_sr";

/// A sample in the plane of incidence.
Sample sample(double theta_i_deg, double theta_r_deg, double brdf, std::optional<double> sigma = {}) {
    return {{theta_i_deg, theta_r_deg, 0}, brdf, sigma};
}

Dataset dataset(std::vector<Channel> channels) { return {"", optim::Unit::per_steradian, std::move(channels)}; }

void expect_refused(const std::string& text, const std::vector<std::string>& places) {
    SCOPED_TRACE(text);
    const Problem problem = refusal_of([&] { (void)read_csv(text); });
    EXPECT_EQ(problem.type.status, 422);
    EXPECT_EQ(places_of(problem), places);
    for (const FieldError& error : problem.errors) EXPECT_EQ(error.pointer, "");
}

TEST(Csv, ReadsTheLeastThereIs) {
    EXPECT_EQ(read_csv(kHead + "\n15,-30,0.1\n0,0,-2e-3"),
              dataset({{"1", {}, {sample(15, -30, 0.1), sample(0, 0, -2e-3)}}}));
}

TEST(Csv, ReadsWhatSpreadsheetsWrite) {
    const Dataset expected = dataset({{"1", {}, {sample(15, 30, 0.1)}}});
    EXPECT_EQ(read_csv("\xEF\xBB\xBF" + kHead + "\r\n15,30,0.1\r\n"), expected);
    EXPECT_EQ(read_csv("# a\n\n  \n# b\n theta_i_deg ,\ttheta_r_deg, brdf_per_sr \n#c\n\n +15 , 30.0,1e-1 \n"),
              expected);
    EXPECT_EQ(read_csv("\"theta_i_deg\",\"theta_r_deg\",\"brdf_per_sr\"\n\"15\",\"30\",\"0.1\"\n"), expected);
    EXPECT_EQ(read_csv("brdf_per_sr,theta_i_deg,theta_r_deg\n0.1,15,30\n"), expected);
}

TEST(Csv, MakesChannelsByNameOrWavelength) {
    EXPECT_EQ(read_csv(kHead + ",wavelength_nm\n1,2,3,550\n1,2,4,650.5\n5,6,7,550\n"),
              dataset({{"550nm", 550, {sample(1, 2, 3), sample(5, 6, 7)}}, {"650.5nm", 650.5, {sample(1, 2, 4)}}}));
    EXPECT_EQ(
        read_csv(kHead + ",channel\n1,2,3,\"red, x\"\n1,2,4,\n1,2,5,grün\n"),
        dataset({{"red, x", {}, {sample(1, 2, 3)}}, {"1", {}, {sample(1, 2, 4)}}, {"grün", {}, {sample(1, 2, 5)}}}));
    EXPECT_EQ(read_csv(kHead + ",channel,wavelength_nm,sigma\n1,2,3,a,550,0.1\n1,2,3,b,550,0.2\n"),
              dataset({{"a", 550, {sample(1, 2, 3, 0.1)}}, {"b", 550, {sample(1, 2, 3, 0.2)}}}));
}

TEST(Csv, SignsAreMeaningfulIfAnyIsNegative) {
    const std::string head = kHead + ",phi_i_deg,phi_r_deg\n";
    EXPECT_EQ(read_csv(head + "15,30,1,0,180\n15,-30,2,0,0\n15,-30,3,90,90\n15,0,4,0,0\n"),
              read_csv(kHead + "\n15,30,1\n15,-30,2\n15,-30,3\n15,0,4\n"));
    // Without a negative angle phi alone tells the side.
    EXPECT_EQ(read_csv(head + "15,30,1,0,180\n15,30,2,0,0\n"), read_csv(kHead + "\n15,30,1\n15,-30,2\n"));
    EXPECT_EQ(read_csv(head + "15,30,1,10,130\n").channels[0].samples[0].direction, (kernels::Direction{15, 30, 60}));
    expect_refused(head + "15,30,1,0,180\n15,-30,1,0,0\n15,-30,1,0,180\n15,30,1,0,0\n",
                   {"4:2 contradiction", "5:2 contradiction"});
}

TEST(Csv, RefusesAHeader) {
    expect_refused("", {"1:1 missing"});
    expect_refused("# only\n", {"1:1 missing"});
    expect_refused(kHead + "\n", {"1:1 missing"});
    expect_refused("# a\n\n" + kHead + ",temperature\n1,2,3,4\n", {"3:4 unknown_key"});
    expect_refused("theta_i_deg,brdf_per_sr\n", {"1:1 missing"});
    expect_refused(kHead + ",sigma,sigma\n", {"1:5 duplicate_key"});
    expect_refused(kHead + ",phi_r_deg\n", {"1:1 missing"});
    expect_refused("15,30,1\n", {"1:1 unknown_key", "1:2 unknown_key", "1:3 unknown_key", "1:1 missing", "1:1 missing",
                                 "1:1 missing"});
}

TEST(Csv, RefusesRows) {
    expect_refused(kHead + "\n1,2\n1,2,3\n1,2,3,4\n", {"2:1 ragged", "4:1 ragged"});
    for (const char* value :
         {"", "x", "nan", "-nan", "inf", "-inf", "1e999", "0x1p3", "1 2", "1e", "++1", "+-1", "1.2.3"})
        expect_refused(kHead + "\n1,2," + value + "\n", {"2:3 not_a_number"});
    expect_refused(kHead + "\n90,2,3\n1,-90,3\n-0.1,90,3\n",
                   {"2:1 out_of_range", "3:2 out_of_range", "4:1 out_of_range", "4:2 out_of_range"});
    expect_refused(
        kHead + ",phi_i_deg,phi_r_deg,sigma,wavelength_nm\n1,2,1e31,361,-361,0,0\n",
        {"2:3 out_of_range", "2:4 out_of_range", "2:5 out_of_range", "2:6 out_of_range", "2:7 out_of_range"});
    expect_refused(kHead + ",channel,wavelength_nm\n1,2,3,a,550\n1,2,3,a,551\n", {"3:5 contradiction"});
}

TEST(Csv, KeepsWhatIsQuoted) {
    const auto name = [](const std::string& field) {
        return read_csv(kHead + ",channel\n1,2,3," + field + "\n").channels[0].name;
    };
    EXPECT_EQ(name(R"("a ""b""")"), R"(a "b")");
    EXPECT_EQ(name(R"(  """"  )"), R"(")");
    EXPECT_EQ(name(R"(" red, x ")"), " red, x ");
    EXPECT_EQ(name("\"\""), "1");
    EXPECT_EQ(read_csv(kHead + "\n\" 15 \",30,0.1\n"), read_csv(kHead + "\n15,30,0.1\n"));
}

TEST(Csv, RefusesQuotesThatDoNotPairAndSaysInWhichField) {
    expect_refused(kHead + ",channel\n1,2,3,\"red\n1,2,3,blue\n", {"2:4 syntax"});
    expect_refused(kHead + ",channel\n1,2,3,a\"b\"\n", {"2:4 syntax"});
    expect_refused(kHead + ",channel\n\"1\"x,2,3,a\n", {"2:1 syntax"});
    expect_refused("\"" + kHead + "\n1,2,3\n", {"1:1 syntax"});
}

TEST(Csv, RefusesAChannelNameThatJsonCouldNotHold) {
    expect_refused(kHead + ",channel\n1,2,3,gr\xFCn\n", {"2:4 not_utf8"});
    expect_refused(kHead + ",channel\n1,2,3," + std::string(201, 'x') + "\n", {"2:4 too_long"});
}

TEST(Csv, RefusesANulByte) {
    expect_refused(kHead + "\n1,2,3" + std::string(1, '\0') + "\n", {"2:3 not_a_number"});
    EXPECT_NO_THROW((void)read_csv(kHead + ",channel\n1,2,3,a\\b\n"));
}

TEST(Csv, TellsMistakesInTheirOrder) {
    expect_refused(kHead + ",channel,wavelength_nm\n1,2,3,a,550\n1,2,3,a,551\n1,2\n1,2,3,a,x\n1,2,3,a,552\n",
                   {"3:5 contradiction", "4:1 ragged", "5:5 not_a_number", "6:5 contradiction"});
}

TEST(Csv, RefusesMoreThanMeansSomething) {
    expect_refused(kHead + "\n" + std::string(1000, ',') + "\n", {"2:1001 too_many"});
    expect_refused(std::string(1'000'000, ','), {"1:1001 too_many"});
    expect_refused(kHead + ",channel\n1,2,3,\"" + std::string((1U << 20U) + 1, 'x') + "\"\n", {"2:4 too_long"});
    std::string text = kHead + "\n";
    for (int i = 0; i < 1'000'001; ++i) text += "1,2,3\n";
    expect_refused(text, {"1000002:1 too_many"});
    text = kHead + ",channel\n";
    for (int i = 0; i < 1001; ++i) text += "1,2,3," + std::to_string(i) + "\n";
    expect_refused(text, {"1002:1 too_many"});
}

TEST(Csv, TellsAtMostFiftyErrors) {
    std::string text = kHead + "\n";
    for (int i = 0; i < 60; ++i) text += "1,2,x\n";
    EXPECT_EQ(refusal_of([&] { (void)read_csv(text); }).errors.size(), kMostErrors);
}

}  // namespace
}  // namespace brdfit::api
