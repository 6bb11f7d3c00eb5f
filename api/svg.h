/// Plots as SVG text: text, shapes, axes and panels, whatever they show. Lengths are in pixels, y points down. Nothing
/// here throws; the same arguments give the same bytes, whatever the locale.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include <fmt/format.h>

namespace brdfit::api {

inline constexpr double kInfinity = std::numeric_limits<double>::infinity();

// ---- text -----------------------------------------------------------------------------------------------------------

/// Text that is XML already.
struct Markup {
    std::string xml;
};

/// UTF-8 as XML. Control characters are dropped, tabs and line ends become spaces; what is not UTF-8, no character of
/// XML, or would change the direction of the text becomes U+FFFD. A text wider than `room` (in units of the font size,
/// estimated) ends in an ellipsis.
Markup escape(std::string_view text, double room = kInfinity);

/// `base` with a subscript, then `rest`; each is XML already.
Markup subscripted(std::string_view base, std::string_view index, std::string_view rest);

/// A number as fmt prints it ("-2e-05"; not empty) with minus signs and a power of ten.
Markup typeset(const std::string& number);

/// At least three digits, or two and an exponent; a dash for none and for what is not finite.
std::string brief(std::optional<double> value);

/// "1 sample", "2 samples".
std::string counted(std::size_t n, std::string_view noun);

// ---- shapes ---------------------------------------------------------------------------------------------------------

/// At most two decimals, no needless zero.
std::string pixels(double value);

template <class T>
using Shown = std::conditional_t<std::is_floating_point_v<T>, std::string, T>;
/// fmt::format where floating-point arguments are pixels().
template <class... Args>
std::string xml(fmt::format_string<Shown<Args>...> format, const Args&... args) {
    const auto shown = []<class T>(const T& value) -> Shown<T> {
        if constexpr (std::is_floating_point_v<T>) return pixels(value);
        else return value;
    };
    return fmt::format(format, shown(args)...);
}

inline constexpr std::string_view kEnd = R"(text-anchor="end")";  ///< text to the left of its x

/// Elements, one a line. Attributes are XML.
struct Svg {
    std::string out;

    void text(double x, double y, const Markup& content, std::string_view attributes);
    /// With a title, which a browser shows on hovering and which is escaped here; nothing for an empty path.
    void path(const std::string& d, std::string_view attributes, std::string_view title = "");
    /// Moves the origin to (x, y) until close_group().
    void open_group(double x, double y);
    void close_group();
};

struct Pixel {
    double x = 0;
    double y = 0;
};
using Line = std::vector<Pixel>;

/// Both ends, and those points between them without which the line would move by more than 0.05 px. Not of an empty
/// line.
Line simplified(const Line& line);

/// The d of a path through the points of each line, to 0.01 px. A lone point becomes a short dash.
std::string path_of(const std::vector<Line>& lines);

/// The d of a circle around (x, y).
std::string circle(double x, double y, double r);

/// The d of a triangle with its tip at (x, y).
std::string arrow(double x, double y, bool up);

/// Attributes of lines and of marks.
struct Style {
    std::string stroke;
    std::string fill;
};
/// Colours of Okabe and Ito, neighbours far apart in luminance, light ones wider; each of the first 49 slots differs in
/// colour or dashes.
Style style(std::size_t slot);

// ---- axes -----------------------------------------------------------------------------------------------------------

/// Empty until something is added.
struct Range {
    double lo = kInfinity;
    double hi = -kInfinity;

    [[nodiscard]] bool empty() const { return lo > hi; }
    [[nodiscard]] bool holds(double value) const { return value >= lo && value <= hi; }
    void add(double value) {
        lo = std::min(lo, value);
        hi = std::max(hi, value);
    }
    /// At least `least` wide, with a margin, a fraction of the width, on both sides. Not of an empty range.
    [[nodiscard]] Range widened(double least, double margin) const {
        const double grow = std::max(0.0, least - (hi - lo)) / 2 + margin * std::max(least, hi - lo);
        return {lo - grow, hi + grow};
    }
};

/// Data (decades, degrees) to pixels; what is far outside stays at four times the length. Needs data.lo < data.hi.
struct Scale {
    Range data;
    double from = 0;  ///< of data.lo
    double to = 1;    ///< of data.hi

    double operator()(double value) const {
        return from + (to - from) * std::clamp((value - data.lo) / (data.hi - data.lo), -4.0, 5.0);
    }
    [[nodiscard]] double per_unit() const { return std::abs(to - from) / (data.hi - data.lo); }
};

struct Tick {
    double at = 0;   ///< in units of the data
    Markup label{};  ///< empty: a minor tick
};

/// Ticks within the scale at multiples of 1, 2 or 5 times a power of ten, at least `spacing` pixels apart.
std::vector<Tick> number_ticks(const Scale& scale, double spacing);

/// Ticks of an axis in degrees, at multiples of 45, or of the least of 30, 15, 10, 5, 2, 1 that leaves 34 pixels
/// between them.
std::vector<Tick> angle_ticks(const Scale& scale);

/// Ticks of an axis in decades: labels at powers of ten, at least `spacing` pixels apart, and at 2 and 5 where those
/// are few.
std::vector<Tick> decade_ticks(const Scale& scale, double spacing);

struct Axis {
    Scale scale;
    std::vector<Tick> ticks;
    bool labels = true;
    Markup title{};
};

/// Its upper left corner is the origin.
struct Panel {
    double width = 0;
    double height = 0;
    Axis x;        ///< its scale runs from 0 to width
    Axis y;        ///< its scale runs from height to 0, or from 0 to height
    Range band{};  ///< of y, shaded
};

/// Grid, ticks and labels. What is drawn from here to close_panel() is clipped to the panel.
void open_panel(Svg& svg, const Panel& panel);
void close_panel(Svg& svg, const Panel& panel);

// ---- pages ----------------------------------------------------------------------------------------------------------

/// Remarks at the foot, wrapped. Returns the height.
double draw_notes(Svg& svg, double y, double width, const std::vector<std::string>& notes);

struct Page {
    std::string heading;
    std::string subtitle;
    std::string description;  ///< for those who do not see it
    double width = 0;         ///< of the layout
    double height = 0;        ///< of the layout
    double shown_width = 0;   ///< to which the layout is scaled
};
/// A whole document: `body` on white, under the heading and subtitle in its upper 50 pixels.
std::string document(const Page& page, const std::string& body);

}  // namespace brdfit::api
