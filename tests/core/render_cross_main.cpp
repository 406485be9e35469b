// Renders the scene of a file with the portable kernel and writes the pixels to another: what
// render_cross_check.py runs on a foreign CPU.
#include <cstdio>
#include <vector>

#include "renderer.h"

using namespace igaussian;

extern "C" void* igaussian_create(const Gaussians*, int antialiased, const char* simd);
extern "C" void igaussian_destroy(void*);
extern "C" int igaussian_render(void*, Frame*);

int main(int, char** arguments) {
  std::FILE* in = std::fopen(arguments[1], "rb");
  int32_t head[4];  // Gaussians, harmonics, width, height
  if (!in || std::fread(head, sizeof(head), 1, in) != 1) return 1;
  const size_t n = head[0], k = head[1], width = head[2], height = head[3];
  std::vector<float> data(n * (3 + 4 + 3 + 1 + 3 * k));
  if (std::fread(data.data(), sizeof(float), data.size(), in) != data.size()) return 2;
  std::fclose(in);
  const float* p = data.data();
  const Gaussians gaussians = {head[0],    head[1],    p,           p + 3 * n,
                               p + 7 * n, p + 10 * n, p + 11 * n};
  void* renderer = igaussian_create(&gaussians, 0, "portable");
  if (!renderer) return 3;
  std::vector<float> out(width * height * 5);
  Frame frame{};
  frame.width = head[2], frame.height = head[3], frame.threads = 2;
  frame.fx = frame.fy = 90, frame.cx = width / 2.0f, frame.cy = height / 2.0f;
  frame.near_plane = 0.01f;
  for (int i = 0; i < 4; ++i) frame.T_cam_scene[5 * i] = 1;
  frame.rgb = out.data();
  frame.depth = out.data() + 3 * width * height;
  frame.alpha = out.data() + 4 * width * height;
  if (igaussian_render(renderer, &frame)) return 4;
  igaussian_destroy(renderer);
  std::FILE* file = std::fopen(arguments[2], "wb");
  if (!file || std::fwrite(out.data(), sizeof(float), out.size(), file) != out.size()) return 5;
  return std::fclose(file);
}
