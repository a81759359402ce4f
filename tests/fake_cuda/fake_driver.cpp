// A CUDA driver for tests: the calls that experiments/silicon makes, on this processor. The kernels
// are the committed sources, compiled into it.
#include "passes.cu"
#include "micro.cu"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>
#include <utility>
#include <vector>

static void fail(const char *what)
{
    fprintf(stderr, "fake CUDA: %s\n", what);
    abort();
}

typedef void (*Call)(void **);
template <class... A, size_t... I> static void call(void (*kernel)(A...), void **values, std::index_sequence<I...>)
{
    kernel(*(A *)values[I]...);
}
template <class... A> static void call(void (*kernel)(A...), void **values)
{
    call(kernel, values, std::index_sequence_for<A...>());
}
#define ENTRY(name) {#name, [](void **values) { call(name, values); }}
static const std::map<std::string, Call> kernels = {
    ENTRY(setup_texture), ENTRY(prefilter_exact_texture), ENTRY(sampling_fixed_texture),
    ENTRY(sampling_adaptive_texture), ENTRY(update_texture), ENTRY(combine_texture), ENTRY(setup_load),
    ENTRY(prefilter_exact_load), ENTRY(sampling_fixed_load), ENTRY(sampling_adaptive_load), ENTRY(update_load),
    ENTRY(combine_load), ENTRY(prefilter_texture), ENTRY(fill_caches), ENTRY(clock_rate), ENTRY(nothing),
    ENTRY(stamp), ENTRY(build_ring), ENTRY(chase_load), ENTRY(chase_readonly), ENTRY(chase_past_l1),
    ENTRY(build_ring_linear), ENTRY(chase_linear), ENTRY(chase_array), ENTRY(near_far), ENTRY(read_own_l1),
    ENTRY(read_own_l2), ENTRY(read_shared), ENTRY(write_shared), ENTRY(scan), ENTRY(neighbours),
    ENTRY(footprint), ENTRY(fetch_rate),
};

struct Function { std::string name; Call run; };
struct Chain { std::vector<HostArray *> levels; };
struct Event { double ms; };
static std::string last_ptx;

struct ArrayDescriptor { size_t width, height, depth; int format; unsigned channels, flags; };
struct Resource { int type; union { void *handle; struct { u64 pointer; int format; unsigned channels; size_t size; } linear; int reserved[32]; } res; unsigned flags; };
struct Sampler { int address[3], filter; unsigned flags, anisotropy; int mip_filter; float bias, low, high, border[4]; int reserved[12]; };
struct Copy { size_t sx, sy; int st; void *sh; u64 sd; HostArray *sa; size_t sp, tx, ty; int tt; void *th; u64 td; HostArray *ta; size_t tp, width, height; };

static HostArray *new_array(const ArrayDescriptor *d, int level)
{
    HostArray *array = new HostArray{nullptr, (int)d->width >> level, (int)d->height >> level, d->format, (int)d->channels};
    array->width = array->width ? array->width : 1;
    array->height = array->height ? array->height : 1;
    array->bytes = (unsigned char *)calloc((size_t)array->width * array->height, array->texel_bytes());
    return array;
}

extern "C" {
int cuInit(unsigned) { return getenv("FAKE_CUDA_NO_GPU") ? 100 : 0; }
int cuDeviceGetCount(int *n) { *n = 1; return 0; }
int cuDeviceGet(int *device, int) { *device = 0; return 0; }
int cuDeviceGetName(char *text, int size, int) { snprintf(text, size, "NVIDIA H100 80GB HBM3 of a test"); return 0; }
int cuDriverGetVersion(int *version) { *version = 12040; return 0; }
int cuDeviceGetAttribute(int *value, int number, int)
{
    static const std::map<int, int> known = {{10, 32}, {13, 2000000}, {16, FAKE_SMS}, {38, 1 << 20}, {39, 2048}, {75, 9}, {76, 0}};
    if (!known.count(number))
        return 1;
    *value = known.at(number);
    return 0;
}
int cuDevicePrimaryCtxRetain(void **context, int) { *context = (void *)1; return 0; }
int cuCtxSetCurrent(void *) { return 0; }
int cuCtxSynchronize() { return 0; }
int cuGetErrorName(int code, const char **text) { *text = code == 100 ? "CUDA_ERROR_NO_DEVICE" : "CUDA_ERROR_OF_A_TEST"; return 0; }
int cuMemGetInfo_v2(size_t *free_bytes, size_t *total) { *free_bytes = 48u << 20; *total = 64u << 20; return 0; }
int cuMemAlloc_v2(u64 *address, size_t size) { *address = (u64)aligned_alloc(256, (size + 255) / 256 * 256); return *address ? 0 : 2; }
int cuMemFree_v2(u64 address) { free((void *)address); return 0; }
int cuMemcpyHtoD_v2(u64 target, const void *source, size_t size) { memcpy((void *)target, source, size); return 0; }
int cuMemcpyDtoH_v2(void *target, u64 source, size_t size) { memcpy(target, (void *)source, size); return 0; }
int cuMemsetD8_v2(u64 target, unsigned char value, size_t size) { memset((void *)target, value, size); return 0; }
int cuArray3DCreate_v2(HostArray **array, const ArrayDescriptor *d)
{
    *array = new_array(d, 0);
    return 0;
}
int cuMipmappedArrayCreate(Chain **chain, const ArrayDescriptor *d, unsigned levels)
{
    *chain = new Chain;
    for (unsigned k = 0; k < levels; ++k)
        (*chain)->levels.push_back(new_array(d, k));
    return 0;
}
int cuMipmappedArrayGetLevel(HostArray **array, Chain *chain, unsigned level)
{
    if (level >= chain->levels.size())
        return 1;
    *array = chain->levels[level];
    return 0;
}
int cuMemcpy2D_v2(const Copy *copy)
{
    const bool up = copy->st == 1 && copy->tt == 3, down = copy->st == 3 && copy->tt == 1;
    if (!up && !down)
        return 1;
    HostArray *array = up ? copy->ta : copy->sa;
    const size_t row = (size_t)array->width * array->texel_bytes();
    if (copy->width != row || copy->height != (size_t)array->height)
        return 1;
    for (size_t y = 0; y < copy->height; ++y) {
        if (up)
            memcpy(array->bytes + y * row, (char *)copy->sh + y * copy->sp, row);
        else
            memcpy((char *)copy->th + y * copy->tp, array->bytes + y * row, row);
    }
    return 0;
}
int cuTexObjectCreate(u64 *handle, const Resource *resource, const Sampler *sampler, const void *)
{
    HostTexture *texture = new HostTexture();
    texture->linear_filter = sampler->filter == 1;
    texture->as_integer = sampler->flags & 1;
    texture->normalised = sampler->flags & 2;
    if (resource->type == 0) {
        texture->levels[texture->num_levels++] = *(HostArray *)resource->res.handle;
    } else if (resource->type == 1) {
        if (!texture->normalised)
            return 1;
        for (HostArray *level : ((Chain *)resource->res.handle)->levels)
            texture->levels[texture->num_levels++] = *level;
    } else if (resource->type == 2) {
        texture->levels[texture->num_levels++] = {(unsigned char *)resource->res.linear.pointer, (int)(resource->res.linear.size / 4), 1, resource->res.linear.format, 1};
    } else {
        return 1;
    }
    // Filtering integers is refused, as by the real driver.
    const int component = texture->levels[0].component;
    if (texture->linear_filter && (component == U32 || texture->as_integer))
        return 1;
    *handle = (u64)texture;
    return 0;
}
int cuSurfObjectCreate(u64 *handle, const Resource *resource)
{
    *handle = (u64)resource->res.handle;
    return resource->type == 0 ? 0 : 1;
}
int cuModuleLoadDataEx(void **module, const char *ptx, unsigned, int *, void **)
{
    last_ptx = ptx;
    *module = new std::string(ptx);
    return strstr(ptx, ".version") ? 0 : 218;
}
int cuModuleGetFunction(Function **function, std::string *module, const char *name)
{
    const std::string full = name, entry = ".visible .entry " + full + "(";
    const size_t cut = full.rfind("__");
    const std::string base = cut == std::string::npos ? full : full.substr(cut + 2);
    if (module->find(entry) == std::string::npos || !kernels.count(base))
        return 500;
    *function = new Function{full, kernels.at(base)};
    return 0;
}
int cuModuleGetGlobal_v2(u64 *address, size_t *size, std::string *module, const char *name)
{
    if (strcmp(name, "setup_levels") || module->find(".visible .const .align 8 .b8 setup_levels[") == std::string::npos)
        return 500;
    *address = (u64)&setup_levels;
    *size = sizeof(setup_levels);
    return 0;
}
int cuFuncSetAttribute(Function *, int, int) { return 1; }
int cuLaunchKernel(Function *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz, unsigned, void *, void **values, void **)
{
    if (!gx || gy != 1 || gz != 1 || !bx || bx > 1024 || by != 1 || bz != 1)
        return 1;
    const char *path = getenv("FAKE_CUDA_LAUNCHES");
    counting = path != nullptr;
    size_t num_sectors = 0;
    gridDim.x = gx;
    blockDim.x = bx;
    for (blockIdx.x = 0; blockIdx.x < gx; ++blockIdx.x) {
        for (threadIdx.x = 0; threadIdx.x < bx; ++threadIdx.x) {
            fetch_number = 0;
            function->run(values);
            if (counting && (threadIdx.x % 32 == 31 || threadIdx.x + 1 == bx)) {
                std::sort(touched.begin(), touched.end());
                num_sectors += std::unique(touched.begin(), touched.end()) - touched.begin();
                touched.clear();
            }
        }
    }
    if (path) {
        FILE *file = fopen(path, "a");
        fprintf(file, "%s %zu\n", function->name.c_str(), num_sectors);
        fclose(file);
    }
    return 0;
}
int cuEventCreate(Event **event, unsigned) { *event = new Event{0}; return 0; }
int cuEventRecord(Event *event, void *)
{
    const auto now = std::chrono::steady_clock::now().time_since_epoch();
    event->ms = std::chrono::duration<double, std::milli>(now).count();
    return 0;
}
int cuEventSynchronize(Event *) { return 0; }
int cuEventElapsedTime(float *ms, Event *begin, Event *end) { *ms = (float)(end->ms - begin->ms) + 1e-4f; return 0; }
int cuEventDestroy_v2(Event *event) { delete event; return 0; }
}
