// Data shared by every instruction set's kernel and by the driver.
//
// Kernel translation units are compiled with flags of their own, so nothing here may emit a weak
// symbol: plain structs and static functions only, or the linker could pick an AVX-512 copy of a
// function that an older CPU then runs.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdlib>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace igaussian {

// At least `bytes` of 64-byte aligned memory for free(); null when there is none. Large pages
// where the system has them: frames read tens of megabytes in no regular order.
static inline void* allocate_bytes(size_t bytes) {
  constexpr size_t kLarge = size_t(1) << 21;
  const size_t alignment = bytes >= 2 * kLarge ? kLarge : 64;
  bytes = (bytes + alignment - 1) / alignment * alignment;
  void* p = std::aligned_alloc(alignment, bytes ? bytes : alignment);
#if defined(__linux__)
  if (p && alignment == kLarge) madvise(p, bytes, MADV_HUGEPAGE);
#endif
  return p;
}

constexpr int kBlock = 16;        // Gaussians stored side by side (structure of arrays)
constexpr int kSuperBlock = 256;  // Gaussians culled by one frustum test
constexpr int kTile = 32;         // pixels a side of a tile
constexpr int kCell = 4;          // pixels a side of a cell; a tile is 8x8 cells
constexpr int kCells = 64;        // cells in a tile: one bit each of a 64-bit mask
constexpr int kPixels = 16;       // pixels in a cell

constexpr float kLog2AlphaMin = -7.994353436858858f;  // log2(1/255)
// Logarithms of alpha are kept times 2^23: as integers they are then the bits of a float whose
// exponent is right (alphas_near)
constexpr float kLogUnit = 8388608.0f, kLogUnitRoot = 2896.309376f;
constexpr float kAlphaMax = 0.99f;
constexpr float kStop = 1e-4f;     // a pixel is finished when its transmittance falls below
constexpr float kLowPass = 0.3f;   // pixels^2 added to each projected covariance

// One axis-aligned box of 256 Gaussians.
struct Box {
  float low[3], high[3];
  float radius;  // largest distance from a mean at which alpha still reaches 1/255
};

// A scene packed for the kernels; arrays are 64-byte aligned, in blocks of kBlock.
struct Model {
  int64_t count;         // real Gaussians; the last block is padded with invisible ones
  int64_t super_blocks;
  int degree;            // spherical harmonics, 0 to 3
  bool antialiased;
  bool half_sh;          // sh holds fp16, otherwise float
  float* mean;           // [block][3][16]
  float* factor;         // [block][9][16], rows of rotation * diag(scale)
  float* log_opacity;    // [block][16], log2
  void* sh;              // [block][K * 3][16]
  int32_t* index;        // [block][16], index in the caller's arrays
  Box* boxes;            // [super_blocks]
};

// One camera, intrinsics with the first pixel's centre at (0, 0).
struct View {
  int width, height;
  float fx, fy, cx, cy;
  float R[9], t[3];      // x_cam = R x_scene + t
  float centre[3];       // camera centre in the scene
  float near_plane;
  double forward[4];     // z = forward . (x, y, z, 1) of a scene point
  float x_limit[2], y_limit[2];  // clamp of x/z and y/z in the Jacobian
};

// A projected Gaussian, one cache line. At (dx, dy) pixels from (u, v)
//   log2(255 * alpha) * 2^23 = reach - (along * dx + shear * dy)^2 - (across * dy)^2,
// the Cholesky form of the inverse covariance: a sum of squares, which does not cancel. Negative
// where alpha is below 1/255.
struct alignas(64) Splat {
  float u, v, along, shear, across, reach;
  float red, green, blue, z;
  // the ellipse alpha = 1/255, at height dy over (u, v), is centred on slope * dy and reaches
  // farthest right at dy_right; inv_along = 1 / along
  float slope, dy_right, inv_along;
  int32_t index;  // in the caller's arrays
  float unused[2];
};
static_assert(sizeof(Splat) == 64, "one cache line");

// Gradient of the loss by a Splat's members, those in units of 2^23 taken without them:
// along, shear and across divided by 2^11.5, log_opacity = log2(opacity).
struct SplatGradient {
  float u, v, along, shear, across, log_opacity;
  float rgb[3], z;
};

// What a tile's Gaussians are sorted by: 40 bits of depth above 24 bits of splat number. Depths
// of a large map are closer to each other than float32 can tell, hence 32 bits of mantissa.
constexpr int kSplatBits = 24;
static inline uint64_t make_key(double depth, uint32_t splat) {
  constexpr double kLeast = 1.1754943508222875e-38;  // 2^-126: eight bits of exponent are kept
  if (!(depth > kLeast)) depth = kLeast;
  uint64_t bits;
  __builtin_memcpy(&bits, &depth, sizeof(bits));
  return ((bits - (uint64_t(1023 - 127) << 52)) >> 20) << kSplatBits | splat;
}
static inline uint64_t depth_of(uint64_t key) { return key >> kSplatBits; }
static inline uint32_t splat_of(uint64_t key) { return key & ((1u << kSplatBits) - 1); }

struct Chunk {
  static constexpr int kKeys = 63;
  uint64_t keys[kKeys];
  Chunk* next;
};
static_assert(sizeof(Chunk) == 512, "eight cache lines");

// Every chunk but the last is full.
struct TileList {
  Chunk *head, *tail;
  int64_t used;  // keys in the tail; kKeys in an empty list, so that the first key takes a chunk
};

static inline int64_t keys_in(const TileList& list, const Chunk* chunk) {
  return chunk == list.tail ? list.used : Chunk::kKeys;
}

// Chunks handed out one by one and taken back all at once; the slabs stay for the next frame.
struct Slab {
  static constexpr int kChunks = 255;
  Slab* next;
  alignas(64) Chunk chunks[kChunks];
};

struct Arena {
  Slab *first, *current;
  int used;  // chunks taken from the current slab
};

// Null when memory has run out.
static inline Chunk* take_chunk(Arena* arena) {
  if (arena->current == nullptr || arena->used == Slab::kChunks) {
    Slab** link = arena->current ? &arena->current->next : &arena->first;
    if (*link == nullptr) {
      *link = static_cast<Slab*>(allocate_bytes(sizeof(Slab)));
      if (*link == nullptr) return nullptr;
      (*link)->next = nullptr;
    }
    arena->current = *link;
    arena->used = 0;
  }
  Chunk* chunk = &arena->current->chunks[arena->used++];
  chunk->next = nullptr;
  return chunk;
}

static inline void reset(Arena* arena) {
  arena->current = nullptr;
  arena->used = 0;
}

// What one thread collects while it projects.
struct Bins {
  TileList* tiles;  // [tiles_y * tiles_x]
  Arena arena;
  int tiles_x, tiles_y;
  int64_t visible, entries;
  bool out_of_memory;
};

// Where a tile's pixels go. Pointers may be null where the caller did not ask.
struct Images {
  float *rgb, *depth, *alpha, *median_depth;
  int32_t* ids;
  float background[3];
};

// Gradients of the loss by a tile's images; null where it does not depend on one.
struct ImageGradients {
  const float *rgb, *depth, *alpha;
};

// The functions of one instruction set.
struct Kernel {
  const char* name;
  bool half_sh;
  // Projects super block number `block` into splats[0..255], files their keys (numbered from
  // first_splat) under the tiles they touch.
  void (*project)(const Model&, const View&, int64_t block, Splat* splats, uint32_t first_splat,
                  Bins*);
  // Blends one tile front to back; keys are sorted. Returns the number of cells evaluated.
  int64_t (*blend)(const View&, const Splat*, const uint64_t* keys, int64_t n, int tile_x,
                   int tile_y, const Images&);
  // Gradients by the tile's Gaussians, one for each key.
  void (*blend_backward)(const View&, const Splat*, const uint64_t* keys, int64_t n, int tile_x,
                         int tile_y, const Images&, const ImageGradients&, SplatGradient*);
};

extern const Kernel kPortableKernel;
#ifdef IGAUSSIAN_X86
extern const Kernel kAvx2Kernel;
extern const Kernel kAvx512Kernel;
#endif

}  // namespace igaussian
