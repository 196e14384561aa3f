// Depth of an image by the plan of a unit: depth unit.plan image.png
#include <torchvts.h>

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>
#ifdef WITH_OPENCV
#include <opencv2/imgcodecs.hpp>
#endif

struct Image {
    int height, width, format;
    std::vector<unsigned char> pixels;
};

#ifdef WITH_OPENCV
static Image read_image(const std::string &path) {
    const cv::Mat read = cv::imread(path, cv::IMREAD_COLOR);
    if (read.empty()) throw std::runtime_error(path + ": no image that OpenCV reads");
    return {read.rows, read.cols, VTS_BGR8, {read.datastart, read.dataend}};
}
#else
// Binary PPM of 8 bits, which ffmpeg, ImageMagick and OpenCV write.
static Image read_image(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    std::string kind;
    int width = 0, height = 0, most = 0;
    file >> kind >> width >> height >> most;
    file.get();
    if (!file || kind != "P6" || most != 255 || width < 1 || height < 1 || width > 1 << 14 || height > 1 << 14)
        throw std::runtime_error(path + ": expected a binary PPM (P6) of 8 bits; built with OpenCV, this reads PNG and JPEG too");
    Image image{height, width, VTS_RGB8, std::vector<unsigned char>(3 * static_cast<size_t>(width) * height)};
    file.read(reinterpret_cast<char *>(image.pixels.data()), static_cast<std::streamsize>(image.pixels.size()));
    if (!file) throw std::runtime_error(path + ": cut short");
    return image;
}
#endif

using Plan = std::unique_ptr<vts_plan, decltype(&vts_free)>;

static Plan read_plan(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + ": no such file");
    const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
    char reason[VTS_REASON];
    Plan plan(vts_load(bytes.data(), bytes.size(), reason), vts_free);
    if (!plan) throw std::runtime_error(path + ": " + reason);
    return plan;
}

int main(int count, char **words) try {
    if (count != 3) throw std::runtime_error("expected a plan and an image: depth unit.plan image.png");
    const Plan plan = read_plan(words[1]);
    vts_facts facts;
    vts_info(plan.get(), &facts);
    const Image image = read_image(words[2]);
    if (image.height != facts.height || image.width != facts.width)
        throw std::runtime_error("expected an image of " + std::to_string(facts.height) + " x " + std::to_string(facts.width) +
                                 " as the plan, got " + std::to_string(image.height) + " x " + std::to_string(image.width));
    std::vector<float> depth(static_cast<size_t>(facts.height) * facts.width);
    vts_output output{};
    output.depth_mm = depth.data();
    const int code = vts_depth(plan.get(), image.pixels.data(), image.format, &output);
    if (code != VTS_DONE) throw std::runtime_error(vts_error(code));
    std::printf("deepest %.3f %s\n", *std::max_element(depth.begin(), depth.end()), facts.metric ? "mm" : "in units that are NOT mm");
    return 0;
} catch (const std::exception &error) {
    std::fprintf(stderr, "depth: %s\n", error.what());
    return 1;
}
