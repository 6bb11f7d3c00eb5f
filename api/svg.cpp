#include "api/svg.h"

#include <array>

namespace brdfit::api {
namespace {

constexpr double kTolerance = 0.05;  ///< of simplified lines [px]
constexpr std::string_view kMiddle = R"(text-anchor="middle")";

/// Reads one code point; U+FFFD for what is not UTF-8 or not allowed in XML.
char32_t next_code_point(std::string_view text, std::size_t& at) {
    constexpr char32_t bad = 0xFFFD;
    constexpr std::array<char32_t, 3> smallest{0x80, 0x800, 0x10000};
    const char32_t lead = static_cast<unsigned char>(text[at++]);
    if (lead < 0x80) return lead;
    if (lead < 0xC2 || lead > 0xF4) return bad;
    const unsigned extra = lead >= 0xF0 ? 3 : lead >= 0xE0 ? 2 : 1;
    char32_t c = lead & (0x3Fu >> extra);
    for (unsigned k = 0; k < extra; ++k, ++at) {
        const char32_t next = at < text.size() ? static_cast<unsigned char>(text[at]) : 0u;
        if ((next & 0xC0u) != 0x80u) return bad;
        c = (c << 6) | (next & 0x3Fu);
    }
    const bool surrogate = c >= 0xD800 && c <= 0xDFFF;
    return c < smallest[extra - 1] || surrogate || c > 0x10FFFF || (c & 0xFFFEu) == 0xFFFEu ? bad : c;
}

/// About the width of a wide font's character, in units of the font size.
double advance(char32_t c) {
    if ((c >= 0x1100 && c < 0x1200) || (c >= 0x2E80 && c < 0xFE00) || c >= 0x10000) return 1;
    return (c >= U'A' && c <= U'Z') || c == U'm' || c == U'w' || c == U'%' || c == U'@' ? 0.8 : 0.56;
}

Markup plain(double value) { return typeset(fmt::format("{:g}", value == 0 ? 0.0 : value)); }

double distance_to_segment(const Pixel& p, const Pixel& a, const Pixel& b) {
    const Pixel d{b.x - a.x, b.y - a.y};
    const double length2 = d.x * d.x + d.y * d.y;
    const double t = length2 > 0 ? std::clamp(((p.x - a.x) * d.x + (p.y - a.y) * d.y) / length2, 0.0, 1.0) : 0.0;
    return std::hypot(p.x - a.x - t * d.x, p.y - a.y - t * d.y);
}

/// Appends line[last] and those points after line[first] without which the line would move by more than kTolerance
/// (Douglas, Peucker).
void add_bends(const Line& line, std::size_t first, std::size_t last, Line& bends) {
    double farthest = kTolerance;
    std::size_t at = last;
    for (std::size_t i = first + 1; i < last; ++i) {
        const double distance = distance_to_segment(line[i], line[first], line[last]);
        if (distance > farthest) farthest = distance, at = i;
    }
    if (at == last) return bends.push_back(line[last]);
    add_bends(line, first, at, bends);
    add_bends(line, at, last, bends);
}

std::vector<Tick> ticks_every(double step, const Scale& scale) {
    std::vector<Tick> ticks;
    for (double k = std::ceil(scale.data.lo / step); k * step <= scale.data.hi; ++k)
        ticks.push_back({k * step, plain(k * step)});
    return ticks;
}

}  // namespace

// ---- text -----------------------------------------------------------------------------------------------------------

Markup escape(std::string_view text, double room) {
    std::string out;
    std::size_t cut = 0;
    double width = 0;
    for (std::size_t at = 0; at < text.size();) {
        const std::size_t begin = at;
        char32_t c = next_code_point(text, at);
        if (c == U'\t' || c == U'\n' || c == U'\r') c = U' ';
        if (c < 0x20 || (c >= 0x7F && c < 0xA0)) continue;
        if (width + 0.8 <= room) cut = out.size();
        width += advance(c);
        if (width > room) return {out.substr(0, cut) + "…"};
        switch (c) {
            case U'&': out += "&amp;"; break;
            case U'<': out += "&lt;"; break;
            case U'>': out += "&gt;"; break;
            case U'"': out += "&quot;"; break;
            case U'\'': out += "&#39;"; break;
            case U' ': out += ' '; break;
            case 0x061C:  // what would turn the text around it about is shown, and does nothing
            case 0x200E:
            case 0x200F:
            case 0x202A:
            case 0x202B:
            case 0x202C:
            case 0x202D:
            case 0x202E:
            case 0x2066:
            case 0x2067:
            case 0x2068:
            case 0x2069:
            case 0xFFFD: out += "\uFFFD"; break;
            default: out += text.substr(begin, at - begin);
        }
    }
    return {out};
}

Markup subscripted(std::string_view base, std::string_view index, std::string_view rest) {
    // A space needs dx, as librsvg drops it.
    return {fmt::format(R"({}<tspan dy="3" font-size="75%">{}</tspan><tspan dx="3" dy="-3">{}</tspan>)", base, index,
                        rest)};
}

Markup typeset(const std::string& text) {
    const auto with_minus = [](const std::string& s) { return s.front() == '-' ? "−" + s.substr(1) : s; };
    const std::size_t e = text.find('e');
    if (e == std::string::npos) return {with_minus(text)};
    const std::string factor = text.substr(0, e) == "1" ? "" : with_minus(text.substr(0, e)) + "×";
    const std::string exponent = with_minus(fmt::format("{}", std::stoi(text.substr(e + 1))));
    return {fmt::format(R"({}10<tspan dy="-4" font-size="75%">{}</tspan>)", factor, exponent)};
}

std::string brief(std::optional<double> value) {
    if (!value || !std::isfinite(*value)) return "–";
    if (*value == 0) return "0";
    if (*value < 1e-3 || *value >= 1e5) return fmt::format("{:.1e}", *value);
    return fmt::format("{:.{}f}", *value, std::max(0, 2 - static_cast<int>(std::floor(std::log10(*value)))));
}

std::string counted(std::size_t n, std::string_view noun) { return fmt::format("{} {}{}", n, noun, n == 1 ? "" : "s"); }

// ---- shapes ---------------------------------------------------------------------------------------------------------

std::string pixels(double value) {
    std::string text = fmt::format("{:.2f}", value);
    text.erase(text.find_last_not_of('0') + 1);
    if (text.back() == '.') text.pop_back();
    return text == "-0" ? "0" : text;
}

void Svg::text(double x, double y, const Markup& content, std::string_view attributes) {
    out += xml("<text x=\"{}\" y=\"{}\" {}>{}</text>\n", x, y, attributes, content.xml);
}

void Svg::path(const std::string& d, std::string_view attributes, std::string_view title) {
    if (d.empty()) return;
    out += xml("<path d=\"{}\" {}", d, attributes);
    out += title.empty() ? "/>\n" : "><title>" + escape(title).xml + "</title></path>\n";
}

void Svg::open_group(double x, double y) { out += xml("<g transform=\"translate({} {})\">\n", x, y); }

void Svg::close_group() { out += "</g>\n"; }

Line simplified(const Line& line) {
    Line bends{line.front()};
    if (line.size() > 1) add_bends(line, 0, line.size() - 1, bends);
    return bends;
}

std::string path_of(const std::vector<Line>& lines) {
    std::string d;
    for (const Line& line : lines) {
        Pixel at;  // steps between rounded points do not drift
        for (const Pixel& p : line) {
            const Pixel next{std::round(p.x * 100) / 100, std::round(p.y * 100) / 100};
            const std::string dy = pixels(next.y - at.y);
            d += (&p == &line.front() ? 'M' : 'l') + pixels(next.x - at.x) + (dy.front() == '-' ? "" : " ") + dy;
            at = next;
        }
        if (line.size() == 1) d += "m-2 0h4";
    }
    return d;
}

std::string circle(double x, double y, double r) {
    return xml("M{0} {1}a{2} {2} 0 1 0 {3} 0a{2} {2} 0 1 0-{3} 0", x - r, y, r, 2 * r);
}

std::string arrow(double x, double y, bool up) { return xml("M{} {}l-3 {}h6z", x, y, up ? 6.0 : -6.0); }

Style style(std::size_t slot) {
    struct Pen {
        std::string_view colour;
        double width;
    };
    constexpr std::array<Pen, 7> pens{{{"#0072B2", 1.6},
                                       {"#E69F00", 2.2},
                                       {"#000000", 1.4},
                                       {"#D55E00", 1.8},
                                       {"#56B4E9", 2.1},
                                       {"#009E73", 1.9},
                                       {"#CC79A7", 2.1}}};
    constexpr std::array<std::string_view, 7> dashes{"none",    "9 3",  "1.5 2.5",    "5 2.5",
                                                     "9 3 2 3", "14 4", "6 3 2 3 2 3"};
    const auto& [colour, width] = pens[slot % pens.size()];
    const std::string_view dash = dashes[(slot + slot / pens.size()) % dashes.size()];
    return {xml(R"(stroke="{}" stroke-width="{}" stroke-dasharray="{}")", colour, width, dash),
            xml(R"(fill="{}")", colour)};
}

// ---- axes -----------------------------------------------------------------------------------------------------------

std::vector<Tick> number_ticks(const Scale& scale, double spacing) {
    const double least = spacing / scale.per_unit();
    const double decade = std::pow(10, std::floor(std::log10(least)));
    const double digit = least <= decade ? 1 : least <= 2 * decade ? 2 : least <= 5 * decade ? 5 : 10;
    return ticks_every(digit * decade, scale);
}

std::vector<Tick> angle_ticks(const Scale& scale) {
    double step = 45;
    for (const double s : {30, 15, 10, 5, 2, 1})
        if (s * scale.per_unit() >= 34) step = s;
    return ticks_every(step, scale);
}

std::vector<Tick> decade_ticks(const Scale& scale, double spacing) {
    const bool few = scale.data.hi - scale.data.lo < 2 && 0.3 * scale.per_unit() >= spacing;
    const bool decimals = few && scale.data.lo > -4 && scale.data.hi < 4;
    int step = 1;
    for (const int s : {2, 5, 10, 20, 50, 100, 200})
        if (step * scale.per_unit() < spacing) step = s;
    std::vector<Tick> ticks;
    for (auto k = static_cast<int>(std::floor(scale.data.lo)); k <= scale.data.hi; ++k) {
        for (int digit = 1; digit < (scale.per_unit() < 30 ? 2 : 10); ++digit) {
            Tick tick{k + std::log10(digit)};
            const bool named = digit == 1 ? k % step == 0 : few && (digit == 2 || digit == 5);
            if (!scale.data.holds(tick.at) || (!named && scale.per_unit() < 3)) continue;
            if (named && decimals) tick.label = plain(digit * std::pow(10, k));
            else if (named && digit > 1) tick.label = plain(digit);  // of the power of ten below
            else if (named) tick.label = typeset(fmt::format("1e{}", k));
            ticks.push_back(tick);
        }
    }
    return ticks;
}

void open_panel(Svg& svg, const Panel& p) {
    std::string grid, marks;
    Svg labels;
    for (const Tick& t : p.x.ticks) {
        const double x = p.x.scale(t.at);
        const bool major = !t.label.xml.empty();
        if (major) grid += xml("M{} 0v{}", x, p.height);
        marks += xml("M{} {}v{}", x, p.height, major ? -5.0 : -3.0);
        if (major && p.x.labels) labels.text(x, p.height + 14, t.label, kMiddle);
    }
    for (const Tick& t : p.y.ticks) {
        const double y = p.y.scale(t.at);
        const bool major = !t.label.xml.empty();
        if (major) grid += xml("M0 {}h{}", y, p.width);
        marks += xml("M0 {}h{}", y, major ? 5.0 : 3.0);
        if (major && p.y.labels) labels.text(-6, y + 3.5, t.label, kEnd);
    }
    if (!p.x.title.xml.empty()) labels.text(p.width / 2, p.height + 30, p.x.title, kMiddle);
    if (!p.y.title.xml.empty()) {
        const std::string turned = xml(R"_({} transform="translate(-46 {})rotate(-90)")_", kMiddle, p.height / 2);
        labels.text(0, 0, p.y.title, turned);
    }
    if (!p.band.empty()) {
        const double top = p.y.scale(p.band.hi);
        const double height = p.y.scale(p.band.lo) - top;
        svg.out += xml("<rect y=\"{}\" width=\"{}\" height=\"{}\" fill=\"#f0f0f0\"/>\n", top, p.width, height);
    }
    svg.path(grid, R"(stroke="#e2e2e2" fill="none")");
    svg.path(marks, R"(stroke="#444" fill="none")");
    svg.out += labels.out;
    svg.out += xml("<svg width=\"{}\" height=\"{}\" overflow=\"hidden\" fill=\"none\">\n", p.width, p.height);
}

void close_panel(Svg& svg, const Panel& p) {
    svg.out += xml("</svg>\n<rect width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"#444\"/>\n", p.width, p.height);
}

// ---- pages ----------------------------------------------------------------------------------------------------------

double draw_notes(Svg& svg, double y, double width, const std::vector<std::string>& notes) {
    std::vector<std::string> lines(1);
    for (const std::string& note : notes) {
        if (static_cast<double>(lines.back().size() + note.size()) > (width - 32) / 5.8) lines.emplace_back();
        lines.back() += (lines.back().empty() ? "" : "; ") + note;
    }
    for (std::size_t i = 0; i < lines.size(); ++i)
        svg.text(16, y + 14 * static_cast<double>(i), escape(lines[i]), R"(fill="#555")");
    return 14 * static_cast<double>(lines.size());
}

std::string document(const Page& page, const std::string& body) {
    Svg svg;
    svg.out = xml(R"(<svg xmlns="http://www.w3.org/2000/svg" role="img" width="{}" height="{}" viewBox="0 0 {} {}")",
                  page.shown_width, page.height * page.shown_width / page.width, page.width, page.height);
    svg.out += " font-family=\"system-ui, Helvetica, Arial, sans-serif\" font-size=\"10\" fill=\"#222\">\n";
    svg.out += xml("<title>{}: {}</title>\n", escape(page.heading).xml, escape(page.subtitle).xml);
    svg.out += xml("<desc>{}</desc>\n", escape(page.description).xml);
    svg.out += xml("<rect width=\"{}\" height=\"{}\" fill=\"#fff\"/>\n", page.width, page.height);
    svg.text(16, 26, escape(page.heading, (page.width - 32) / 16), R"(font-size="16" font-weight="600")");
    svg.text(16, 44, escape(page.subtitle, (page.width - 32) / 11), R"(font-size="11" fill="#555")");
    return svg.out + body + "</svg>\n";
}

}  // namespace brdfit::api
