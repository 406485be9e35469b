// Frames: cull, project and bin (threads over super blocks), then sort and blend (threads over
// tiles). The C interface that Python loads is at the end.
#include "renderer.h"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstring>
#include <memory>
#include <new>

#include "pool.h"

namespace igaussian {
namespace {

using Clock = std::chrono::steady_clock;

int64_t since(Clock::time_point start) {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - start).count();
}

// Memory that grows and is never zeroed, 64-byte aligned.
template <class T>
class Buffer {
 public:
  ~Buffer() { std::free(data_); }
  T* at_least(size_t count) {
    if (count > capacity_) {
      std::free(data_);
      capacity_ = 0;
      const size_t wanted = count + count / 4;
      data_ = static_cast<T*>(allocate_bytes(wanted * sizeof(T)));
      if (!data_) throw std::bad_alloc();
      capacity_ = wanted;
    }
    return data_;
  }
  T* data() { return data_; }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

void free_arena(Arena* arena) {
  for (Slab* slab = arena->first; slab;) {
    Slab* next = slab->next;
    std::free(slab);
    slab = next;
  }
}

// What one thread owns from frame to frame.
struct Worker {
  Bins bins{};
  std::vector<TileList> tiles;
  Buffer<uint64_t> keys, spare;
  int64_t nanoseconds[3];
  int64_t cells;
  ~Worker() { free_arena(&bins.arena); }
};

View make_view(const Frame& f) {
  View v;
  v.width = f.width;
  v.height = f.height;
  v.fx = f.fx, v.fy = f.fy, v.cx = f.cx, v.cy = f.cy;
  v.near_plane = f.near_plane;
  const double* T = f.T_cam_scene;
  std::copy(T + 8, T + 12, v.forward);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) v.R[i * 3 + j] = static_cast<float>(T[i * 4 + j]);
    v.t[i] = static_cast<float>(T[i * 4 + 3]);
    v.centre[i] = static_cast<float>(-(T[i] * T[3] + T[4 + i] * T[7] + T[8 + i] * T[11]));
  }
  // the image's edges lie half a pixel outside the outer pixel centres; 3DGS widens the field of
  // view by 0.3 of its half before it clamps
  const float half_x = 0.5f * f.width / f.fx, half_y = 0.5f * f.height / f.fy;
  v.x_limit[0] = -(f.cx + 0.5f) / f.fx - 0.3f * half_x;
  v.x_limit[1] = (f.width - 0.5f - f.cx) / f.fx + 0.3f * half_x;
  v.y_limit[0] = -(f.cy + 0.5f) / f.fy - 0.3f * half_y;
  v.y_limit[1] = (f.height - 0.5f - f.cy) / f.fy + 0.3f * half_y;
  return v;
}

// A plane through the camera centre and one edge of the image; inside is positive.
struct Plane {
  float normal[3], offset;
  float reach;  // how far past the plane a Gaussian of radius 1 still shows, Jacobian included
  float pixel;  // distance of one pixel, at depth 1, from the plane
};

Plane edge_plane(const View& v, bool horizontal, bool far_edge) {
  const float f = horizontal ? v.fx : v.fy, c = horizontal ? v.cx : v.cy;
  const float size = static_cast<float>(horizontal ? v.width : v.height);
  const float a = far_edge ? -f : f;                      // times x (or y)
  const float b = far_edge ? size - 0.5f - c : c + 0.5f;  // times z
  const float length = std::hypot(a, b);
  const float* limit = horizontal ? v.x_limit : v.y_limit;
  const float widest = std::max(std::fabs(limit[0]), std::fabs(limit[1]));
  Plane p;
  for (int k = 0; k < 3; ++k) {
    p.normal[k] = (a * v.R[(horizontal ? 0 : 3) + k] + b * v.R[6 + k]) / length;
  }
  p.offset = (a * v.t[horizontal ? 0 : 1] + b * v.t[2]) / length;
  p.reach = f * std::sqrt(1 + widest * widest) / length;
  p.pixel = 1 / length;
  return p;
}

float farthest(const float* normal, float offset, const Box& box) {
  for (int k = 0; k < 3; ++k) {
    offset += normal[k] * (normal[k] > 0 ? box.high[k] : box.low[k]);
  }
  return offset;
}

void cull(const Model& model, const View& view, std::vector<int32_t>* seen) {
  seen->clear();
  Plane planes[4];
  for (int i = 0; i < 4; ++i) planes[i] = edge_plane(view, i < 2, i % 2);
  constexpr float kLowPassPixels = 2.5f;  // sqrt(2 ln 255 * 0.3) and half a pixel, rounded up
  for (int64_t s = 0; s < model.super_blocks; ++s) {
    const Box& box = model.boxes[s];
    if (!(box.low[0] <= box.high[0])) continue;
    const float depth = farthest(view.R + 6, view.t[2], box);
    bool inside = depth >= view.near_plane * 0.999f;
    for (int i = 0; i < 4 && inside; ++i) {
      const float slack =
          box.radius * planes[i].reach * 1.001f + depth * planes[i].pixel * kLowPassPixels;
      inside = farthest(planes[i].normal, planes[i].offset, box) >= -slack;
    }
    if (inside) seen->push_back(static_cast<int32_t>(s));
  }
}

void counts_to_starts(uint32_t* counts) {
  uint32_t sum = 0;
  for (int i = 0; i < 256; ++i) {
    const uint32_t count = counts[i];
    counts[i] = sum;
    sum += count;
  }
}

// Nearly sorted keys; gives up after too many moves.
bool insertion_sort(uint64_t* keys, size_t n) {
  size_t moves = 0;
  for (size_t i = 1; i < n; ++i) {
    const uint64_t key = keys[i];
    size_t j = i;
    for (; j > 0 && keys[j - 1] > key; --j) keys[j] = keys[j - 1];
    keys[j] = key;
    moves += i - j;
    if (moves > 8 * n) return false;
  }
  return true;
}

// Exact order of (depth, number): two radix passes on 16 bits of the tile's depth range, then
// insertion for what falls together.
void sort_keys(uint64_t* keys, uint64_t* spare, size_t n) {
  if (n < 48) {
    std::sort(keys, keys + n);
    return;
  }
  uint64_t least = ~uint64_t(0), most = 0;
  for (size_t i = 0; i < n; ++i) {
    least = std::min(least, depth_of(keys[i]));
    most = std::max(most, depth_of(keys[i]));
  }
  int shift = 0;
  while ((most - least) >> shift >> 16) ++shift;
  const auto digits = [&](uint64_t key) {
    return static_cast<uint32_t>((depth_of(key) - least) >> shift);
  };
  uint32_t low[256] = {}, high[256] = {};
  for (size_t i = 0; i < n; ++i) {
    const uint32_t d = digits(keys[i]);
    ++low[d & 255];
    ++high[d >> 8];
  }
  counts_to_starts(low);
  counts_to_starts(high);
  for (size_t i = 0; i < n; ++i) spare[low[digits(keys[i]) & 255]++] = keys[i];
  for (size_t i = 0; i < n; ++i) keys[high[digits(spare[i]) >> 8]++] = spare[i];
  if (!insertion_sort(keys, n)) std::sort(keys, keys + n);
}

}  // namespace

class Renderer {
 public:
  Renderer(std::shared_ptr<const Model> model, const Kernel& kernel)
      : model_(std::move(model)), kernel_(kernel) {}
  ~Renderer() { forget_lost_threads(); }
  void render(Frame* frame);
  void render_batch(Frame* frames, int count, int threads);
  void backward(Frame* frame, const Gaussians& gaussians, Gradients* gradients);

 private:
  template <class Job>
  void run(int threads, Job job);
  void project_all(Frame* frame, const View& view);
  void blend_backward(int thread, const View& view, const Images& images,
                      const ImageGradients& gradients);
  void add_up(int thread, int threads);

  void prepare(const Frame& frame);
  void project(int thread, const View& view);
  size_t count_keys(int tile) const;
  void gather_keys(int tile, uint64_t* keys);
  void blend(int thread, const View& view, const Images& images);
  Pool& pool(int threads);
  void forget_lost_threads();

  std::shared_ptr<const Model> model_;
  const Kernel& kernel_;
  std::vector<std::unique_ptr<Renderer>> lanes_;  // of render_batch, one for each thread
  std::unique_ptr<Pool> pool_;
  pid_t pool_process_ = 0;
  std::vector<std::unique_ptr<Worker>> workers_;
  std::vector<int32_t> seen_;
  Buffer<Splat> splats_;
  // of a backward pass: (Gaussian, tile) pairs tile by tile, and where each tile's begin
  std::vector<size_t> entry_starts_;
  Buffer<uint32_t> entry_splats_;
  Buffer<SplatGradient> entry_gradients_, splat_gradients_;
  std::atomic<int> next_{0};
  int tiles_x_ = 0, tiles_y_ = 0;
};

// Threads do not survive a fork: in the child the pool cannot be joined, its memory is given up.
void Renderer::forget_lost_threads() {
  if (pool_ && pool_process_ != getpid()) (void)pool_.release();
}

Pool& Renderer::pool(int threads) {
  forget_lost_threads();
  if (!pool_ || pool_->workers() != threads - 1) {
    pool_.reset();
    pool_ = std::make_unique<Pool>(threads - 1);
    pool_process_ = getpid();
  }
  return *pool_;
}

void Renderer::prepare(const Frame& frame) {
  tiles_x_ = (frame.width + kTile - 1) / kTile;
  tiles_y_ = (frame.height + kTile - 1) / kTile;
  const size_t tiles = static_cast<size_t>(tiles_x_) * tiles_y_;
  while (workers_.size() < static_cast<size_t>(frame.threads)) {
    workers_.push_back(std::make_unique<Worker>());
  }
  for (auto& worker : workers_) {
    worker->tiles.assign(tiles, TileList{nullptr, nullptr, Chunk::kKeys});
    Bins& bins = worker->bins;
    bins.tiles = worker->tiles.data();
    reset(&bins.arena);
    bins.tiles_x = tiles_x_;
    bins.tiles_y = tiles_y_;
    bins.visible = bins.entries = worker->cells = 0;
    bins.out_of_memory = false;
    std::fill(worker->nanoseconds, worker->nanoseconds + 3, 0);
  }
}

void Renderer::project(int thread, const View& view) {
  const auto start = Clock::now();
  Worker& worker = *workers_[thread];
  for (;;) {
    const int i = next_.fetch_add(1, std::memory_order_relaxed);
    if (i >= static_cast<int>(seen_.size())) break;
    const uint32_t first = static_cast<uint32_t>(i) * kSuperBlock;
    kernel_.project(*model_, view, seen_[i], splats_.data() + first, first, &worker.bins);
  }
  worker.nanoseconds[0] += since(start);
}

size_t Renderer::count_keys(int tile) const {
  size_t n = 0;
  for (const auto& worker : workers_) {
    const TileList& list = worker->tiles[tile];
    for (const Chunk* c = list.head; c; c = c->next) n += keys_in(list, c);
  }
  return n;
}

// Copies the keys of a tile; their splats come into the cache on the way.
void Renderer::gather_keys(int tile, uint64_t* keys) {
  const Splat* splats = splats_.data();
  for (const auto& worker : workers_) {
    const TileList& list = worker->tiles[tile];
    for (const Chunk* c = list.head; c; c = c->next) {
      const int64_t size = keys_in(list, c);
      for (int64_t i = 0; i < size; ++i) {
        *keys++ = c->keys[i];
        __builtin_prefetch(&splats[splat_of(c->keys[i])]);
      }
    }
  }
}

void Renderer::blend(int thread, const View& view, const Images& images) {
  Worker& worker = *workers_[thread];
  const int tiles = tiles_x_ * tiles_y_;
  auto start = Clock::now();
  for (;;) {
    const int tile = next_.fetch_add(1, std::memory_order_relaxed);
    if (tile >= tiles) break;
    const size_t n = count_keys(tile);
    uint64_t* keys = worker.keys.at_least(n);
    uint64_t* spare = worker.spare.at_least(n);
    gather_keys(tile, keys);
    sort_keys(keys, spare, n);
    worker.bins.entries += n;
    const auto sorted = Clock::now();
    worker.nanoseconds[1] +=
        std::chrono::duration_cast<std::chrono::nanoseconds>(sorted - start).count();
    worker.cells += kernel_.blend(view, splats_.data(), keys, static_cast<int64_t>(n),
                                  tile % tiles_x_, tile / tiles_x_, images);
    start = Clock::now();
    worker.nanoseconds[2] +=
        std::chrono::duration_cast<std::chrono::nanoseconds>(start - sorted).count();
  }
  std::atomic_thread_fence(std::memory_order_seq_cst);  // for pixels written past the cache
}

// job(thread) on each thread, with next_ counting from 0.
template <class Job>
void Renderer::run(int threads, Job job) {
  next_ = 0;
  std::atomic<bool> failed{false};
  pool(threads).run([&](int thread) {
    try {
      job(thread);
    } catch (const std::bad_alloc&) {
      failed = true;
    }
  });
  if (failed) throw std::bad_alloc();
}

void Renderer::project_all(Frame* frame, const View& view) {
  frame->threads = std::max(1, std::min(frame->threads, kMaxThreads));
  prepare(*frame);
  cull(*model_, view, &seen_);
  splats_.at_least(seen_.size() * kSuperBlock);
  run(frame->threads, [&](int thread) { project(thread, view); });
  for (const auto& worker : workers_) {
    if (worker->bins.out_of_memory) throw std::bad_alloc();
  }
}

Images images_of(const Frame& f) {
  return {f.rgb, f.depth, f.alpha, f.median_depth, f.ids,
          {f.background[0], f.background[1], f.background[2]}};
}

void Renderer::render(Frame* frame) {
  const View view = make_view(*frame);
  project_all(frame, view);
  const Images images = images_of(*frame);
  run(frame->threads, [&](int thread) { blend(thread, view, images); });
  std::fill(frame->nanoseconds, frame->nanoseconds + 3, 0);
  frame->visible = frame->entries = frame->cells = 0;
  for (const auto& worker : workers_) {
    for (int k = 0; k < 3; ++k) frame->nanoseconds[k] += worker->nanoseconds[k];
    frame->visible += worker->bins.visible;
    frame->entries += worker->bins.entries;
    frame->cells += worker->cells;
  }
}

// Small views: a thread for each view, not for each part of a view.
void Renderer::render_batch(Frame* frames, int count, int threads) {
  threads = std::max(1, std::min(std::min(threads, count), kMaxThreads));
  while (lanes_.size() < static_cast<size_t>(threads)) {
    lanes_.push_back(std::make_unique<Renderer>(model_, kernel_));
  }
  run(threads, [&](int thread) {
    for (;;) {
      const int i = next_.fetch_add(1, std::memory_order_relaxed);
      if (i >= count) break;
      frames[i].threads = 1;
      lanes_[thread]->render(&frames[i]);
    }
  });
}

void Renderer::blend_backward(int thread, const View& view, const Images& images,
                              const ImageGradients& gradients) {
  Worker& worker = *workers_[thread];
  const int tiles = tiles_x_ * tiles_y_;
  for (;;) {
    const int tile = next_.fetch_add(1, std::memory_order_relaxed);
    if (tile >= tiles) break;
    const size_t start = entry_starts_[tile], n = entry_starts_[tile + 1] - start;
    if (n == 0) continue;
    uint64_t* keys = worker.keys.at_least(n);
    uint64_t* spare = worker.spare.at_least(n);
    gather_keys(tile, keys);
    sort_keys(keys, spare, n);
    for (size_t i = 0; i < n; ++i) {
      entry_splats_.data()[start + i] = splat_of(keys[i]);
    }
    kernel_.blend_backward(view, splats_.data(), keys, static_cast<int64_t>(n), tile % tiles_x_,
                           tile / tiles_x_, images, gradients, entry_gradients_.data() + start);
  }
}

// Sums the entries of this thread's share of the splats, in the order of the tiles: the result
// does not depend on the number of threads.
void Renderer::add_up(int thread, int threads) {
  const size_t splats = seen_.size() * kSuperBlock;
  const size_t first = splats * thread / threads, last = splats * (thread + 1) / threads;
  SplatGradient* sums = splat_gradients_.data();
  std::fill(sums + first, sums + last, SplatGradient{});
  const size_t entries = entry_starts_.back();
  for (size_t i = 0; i < entries; ++i) {
    const uint32_t splat = entry_splats_.data()[i];
    if (splat < first || splat >= last) continue;
    const float* from = &entry_gradients_.data()[i].u;
    float* to = &sums[splat].u;
    for (size_t k = 0; k < sizeof(SplatGradient) / sizeof(float); ++k) to[k] += from[k];
  }
}

void Renderer::backward(Frame* frame, const Gaussians& gaussians, Gradients* gradients) {
  const View view = make_view(*frame);
  project_all(frame, view);
  const int tiles = tiles_x_ * tiles_y_;
  entry_starts_.assign(tiles + 1, 0);
  for (int tile = 0; tile < tiles; ++tile) {
    entry_starts_[tile + 1] = entry_starts_[tile] + count_keys(tile);
  }
  const size_t entries = entry_starts_.back(), splats = seen_.size() * kSuperBlock;
  entry_splats_.at_least(entries);
  entry_gradients_.at_least(entries);
  splat_gradients_.at_least(splats);
  const Images images = images_of(*frame);
  const ImageGradients by_images = {gradients->rgb, gradients->depth, gradients->alpha};
  run(frame->threads, [&](int thread) { blend_backward(thread, view, images, by_images); });
  run(frame->threads, [&](int thread) { add_up(thread, frame->threads); });

  // one sum by the camera for each super block, added in order
  std::vector<double> by_camera(seen_.size() * 12, 0.0);
  std::vector<uint8_t> drawn(splats, 0);
  for (size_t i = 0; i < entries; ++i) drawn[entry_splats_.data()[i]] = 1;
  run(frame->threads, [&](int) {
    for (;;) {
      const size_t block = static_cast<size_t>(next_.fetch_add(1, std::memory_order_relaxed));
      if (block >= seen_.size()) break;
      for (size_t i = block * kSuperBlock; i < (block + 1) * kSuperBlock; ++i) {
        if (!drawn[i]) continue;
        chain_rule(gaussians, view, model_->antialiased, splats_.data()[i].index,
                   splat_gradients_.data()[i], *gradients, &by_camera[block * 12]);
      }
    }
  });
  std::fill(gradients->T_cam_scene, gradients->T_cam_scene + 16, 0.0);
  for (size_t i = 0; i < by_camera.size(); ++i) gradients->T_cam_scene[i % 12] += by_camera[i];
}

namespace {

const Kernel* find_kernel(const char* name) {
#ifdef IGAUSSIAN_X86
  if (!std::strcmp(name, "avx512") && __builtin_cpu_supports("avx512f") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("bmi2")) {
    return &kAvx512Kernel;
  }
  // every CPU with AVX2 and FMA also has F16C
  if (!std::strcmp(name, "avx2") && __builtin_cpu_supports("avx2") &&
      __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) {
    return &kAvx2Kernel;
  }
#endif
  return std::strcmp(name, "portable") ? nullptr : &kPortableKernel;
}

}  // namespace
}  // namespace igaussian

using namespace igaussian;

#define IGAUSSIAN_API extern "C" __attribute__((visibility("default")))

IGAUSSIAN_API int igaussian_abi() { return 2; }

// 1 where this CPU runs the instruction set "avx512", "avx2" or "portable".
IGAUSSIAN_API int igaussian_supports(const char* simd) { return find_kernel(simd) != nullptr; }

IGAUSSIAN_API void* igaussian_create(const Gaussians* gaussians, int antialiased,
                                     const char* simd) {
  const Kernel* kernel = find_kernel(simd);
  if (!kernel) return nullptr;
  try {
    std::shared_ptr<const Model> model(pack_model(*gaussians, antialiased != 0, kernel->half_sh),
                                       [](const Model* m) { free_model(const_cast<Model*>(m)); });
    return model ? new Renderer(std::move(model), *kernel) : nullptr;
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

IGAUSSIAN_API void igaussian_destroy(void* renderer) { delete static_cast<Renderer*>(renderer); }

IGAUSSIAN_API int igaussian_render(void* renderer, Frame* frame) {
  try {
    static_cast<Renderer*>(renderer)->render(frame);
    return kOk;
  } catch (...) {
    return kOutOfMemory;
  }
}

IGAUSSIAN_API int igaussian_render_batch(void* renderer, Frame* frames, int count, int threads) {
  try {
    static_cast<Renderer*>(renderer)->render_batch(frames, count, threads);
    return kOk;
  } catch (...) {
    return kOutOfMemory;
  }
}

// Gradients of a loss by the Gaussians (those the renderer was made of) and by the camera.
IGAUSSIAN_API int igaussian_backward(void* renderer, Frame* frame, const Gaussians* gaussians,
                                     Gradients* gradients) {
  try {
    static_cast<Renderer*>(renderer)->backward(frame, *gaussians, gradients);
    return kOk;
  } catch (...) {
    return kOutOfMemory;
  }
}
