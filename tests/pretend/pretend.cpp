// A pretend accelerator: device "pretend" (PrivateUse1) whose memory is host memory.
//
// Every operator that PyTorch does not decompose runs its CPU kernel on aliases of the same memory,
// so results equal the CPU's. It is strict like CUDA: operators may not mix devices, except for CPU
// scalars (0-dim) and CPU indices of index and index_put_; integer matrix products and poolings,
// which CUDA lacks, raise; CPU generators raise. It reports transfers, synchronizations and
// operators to a callback, and counts live and peak bytes.
#include <ATen/EmptyTensor.h>
#include <ATen/core/GeneratorForPrivateuseone.h>
#include <ATen/core/Tensor.h>
#include <ATen/core/dispatch/Dispatcher.h>
#include <ATen/detail/PrivateUse1HooksInterface.h>
#include <ATen/native/Resize.h>
#include <ATen/ops/_reshape_alias_native.h>
#include <ATen/ops/as_strided_native.h>
#include <ATen/ops/convolution.h>
#include <ATen/ops/resize_native.h>
#include <ATen/ops/set_native.h>
#include <ATen/ops/unfold_native.h>
#include <ATen/ops/view_as_complex_native.h>
#include <ATen/ops/view_as_real_native.h>
#include <ATen/ops/view_native.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <atomic>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <unordered_map>
#include <unordered_set>

namespace {

using c10::Device;
using c10::DeviceType;
using c10::IValue;
constexpr auto kPretend = DeviceType::PrivateUse1;

// kind: 0 operator, 1 device to CPU, 2 CPU to device, 3 item, 4 synchronizing operator, 5 CPU scalar.
using Hook = void (*)(int kind, const char* name, int64_t bytes, int64_t numel, int dtype);
Hook hook = nullptr;
std::atomic<int64_t> live{0}, peak{0};
std::atomic<bool> strict{true};

void report(int kind, const char* name, int64_t bytes, int64_t numel, int dtype) {
  if (hook) hook(kind, name, bytes, numel, dtype);
}

void count(int64_t bytes) {
  const int64_t now = live += bytes;
  int64_t old = peak;
  while (now > old && !peak.compare_exchange_weak(old, now)) {
  }
}

struct Block {  // Owned memory, or the CPU storage of a result.
  void* memory;
  size_t size;
  c10::Storage storage;
};

void release(void* context) {
  auto* block = static_cast<Block*>(context);
  count(-static_cast<int64_t>(block->size));
  if (!block->storage) std::free(block->memory);
  delete block;
}

struct Allocator final : c10::Allocator {
  c10::DataPtr allocate(size_t size) override {
    void* memory = nullptr;
    if (size) {
      TORCH_CHECK(posix_memalign(&memory, 64, size) == 0, "pretend: out of memory");
      std::memset(memory, 0x7f, size);  // Memory of a device is not zero.
    }
    count(size);
    return {memory, new Block{memory, size, c10::Storage()}, &release, Device(kPretend, 0)};
  }
  c10::DeleterFnPtr raw_deleter() const override { return nullptr; }
  void copy_data(void* to, const void* from, std::size_t size) const override {
    std::memcpy(to, from, size);
  }
};
Allocator allocator;
REGISTER_ALLOCATOR(kPretend, &allocator);

struct Guard final : c10::impl::DeviceGuardImplInterface {
  DeviceType type() const override { return kPretend; }
  Device exchangeDevice(Device) const override { return {kPretend, 0}; }
  Device getDevice() const override { return {kPretend, 0}; }
  void setDevice(Device) const override {}
  void uncheckedSetDevice(Device) const noexcept override {}
  c10::Stream getStream(Device d) const override { return c10::Stream(c10::Stream::DEFAULT, d); }
  c10::Stream getDefaultStream(Device d) const override { return c10::Stream(c10::Stream::DEFAULT, d); }
  c10::Stream exchangeStream(c10::Stream s) const override { return s; }
  c10::DeviceIndex deviceCount() const noexcept override { return 1; }
  void record(void**, const c10::Stream&, c10::DeviceIndex, c10::EventFlag) const override {}
  void block(void*, const c10::Stream&) const override {}
  bool queryEvent(void*) const override { return true; }
};
C10_REGISTER_GUARD_IMPL(PrivateUse1, Guard);

struct Hooks final : at::PrivateUse1HooksInterface {
  bool isBuilt() const override { return true; }
  bool isAvailable() const override { return true; }
  bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
  c10::DeviceIndex deviceCount() const override { return 1; }
  c10::DeviceIndex getCurrentDevice() const override { return 0; }
  void setCurrentDevice(c10::DeviceIndex) const override {}
  c10::DeviceIndex exchangeDevice(c10::DeviceIndex) const override { return 0; }
  c10::DeviceIndex maybeExchangeDevice(c10::DeviceIndex) const override { return 0; }
  void resizePrivateUse1Bytes(const c10::Storage& storage, size_t size) const override {
    at::native::resize_bytes_cpu(storage.unsafeGetStorageImpl(), size);
  }
};

// CPU aliases of the device tensors of one call.
struct Aliases {
  std::unordered_map<c10::StorageImpl*, c10::Storage> to_cpu, to_device;

  at::Tensor cpu(const at::Tensor& tensor) {
    auto& mine = to_cpu[tensor.storage().unsafeGetStorageImpl()];
    if (!mine) {
      auto* owner = new c10::Storage(tensor.storage());
      c10::DataPtr data(
          tensor.storage().mutable_data(), owner,
          [](void* context) { delete static_cast<c10::Storage*>(context); }, Device(DeviceType::CPU));
      mine = c10::Storage(c10::make_intrusive<c10::StorageImpl>(
          c10::StorageImpl::use_byte_size_t(), tensor.storage().nbytes(), std::move(data),
          c10::GetAllocator(DeviceType::CPU), true));
      to_device[mine.unsafeGetStorageImpl()] = tensor.storage();
    }
    return like(tensor, mine, c10::DispatchKey::CPU);
  }

  at::Tensor device(const at::Tensor& tensor) {
    auto found = to_device.find(tensor.storage().unsafeGetStorageImpl());
    return like(tensor, found == to_device.end() ? wrap(tensor.storage()) : found->second,
                c10::DispatchKey::PrivateUse1);
  }

  static c10::Storage wrap(const c10::Storage& storage) {
    const auto size = storage.nbytes();
    count(size);
    auto* memory = const_cast<void*>(storage.data());
    c10::DataPtr data(memory, new Block{memory, size, storage}, &release, Device(kPretend, 0));
    return c10::Storage(c10::make_intrusive<c10::StorageImpl>(
        c10::StorageImpl::use_byte_size_t(), size, std::move(data), &allocator, true));
  }

  static at::Tensor like(const at::Tensor& tensor, const c10::Storage& storage, c10::DispatchKey key) {
    auto made = at::detail::make_tensor<c10::TensorImpl>(
        c10::Storage(storage), c10::DispatchKeySet(key), tensor.dtype());
    made.unsafeGetTensorImpl()->set_sizes_and_strides(
        tensor.sizes(), tensor.strides(), tensor.storage_offset());
    if (tensor.unsafeGetTensorImpl()->is_wrapped_number())
      made.unsafeGetTensorImpl()->set_wrapped_number(true);
    return made;
  }

  // Give an argument what its alias became, after a resize.
  void take_back(const at::Tensor& original, const at::Tensor& alias) {
    auto* impl = original.unsafeGetTensorImpl();
    if (alias.storage().data() != original.storage().data()) {
      impl->set_storage_keep_dtype(wrap(alias.storage()));
    }
    if (alias.sizes() != original.sizes() || alias.strides() != original.strides() ||
        alias.storage_offset() != original.storage_offset()) {
      impl->set_sizes_and_strides(alias.sizes(), alias.strides(), alias.storage_offset());
    }
  }
};

bool is_device(const at::Tensor& tensor) {
  return tensor.defined() && tensor.device().type() == kPretend;
}

// Operators that read values from the device in CUDA, before they know the size of their result.
const std::unordered_set<std::string> kSynchronizing = {
    "nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive",
    "unique_dim_consecutive", "bincount", "repeat_interleave", "equal", "is_nonzero", "histc",
    "_linalg_check_errors", "multinomial", "argwhere", "_assert_async_never"};
// Operators that refuse CPU scalars in CUDA: all that are no element-wise iterations.
const std::unordered_set<std::string> kNoCpuScalars = {
    "cat", "gather", "scatter", "scatter_add", "scatter_reduce", "scatter_", "index_select",
    "index_add", "index_copy", "searchsorted", "bucketize", "mm", "bmm", "addmm", "baddbmm", "dot",
    "mv", "take", "masked_select", "unique_dim", "bincount", "linalg_eigh", "_linalg_eigh"};
// Operators that CUDA lacks for integers.
const std::unordered_set<std::string> kNoIntegers = {
    "mm", "bmm", "addmm", "baddbmm", "dot", "mv", "addmv", "vdot", "max_pool2d_with_indices",
    "avg_pool2d", "avg_pool3d", "max_pool3d_with_indices", "adaptive_avg_pool2d", "convolution",
    "im2col", "cdist", "_cdist_forward"};

std::string base_name(const c10::OperatorHandle& op) {
  std::string name = op.operator_name().name;
  name = name.substr(name.find("::") + 2);
  if (name.size() > 1 && name.back() == '_' && name != "scatter_") name.pop_back();
  return name;
}

void fallback(const c10::OperatorHandle& op, c10::DispatchKeySet, torch::jit::Stack* stack) {
  const auto& schema = op.schema();
  const auto num_args = schema.arguments().size();
  const auto name = base_name(op);
  const bool indexes = name == "index" || name == "index_put" || name == "_index_put_impl" ||
                       name == "_unsafe_index" || name == "_unsafe_index_put";
  std::vector<IValue> originals(stack->end() - num_args, stack->end());
  std::vector<IValue> converted;
  converted.reserve(num_args);
  Aliases aliases;
  std::string mixed;
  bool any_device = false;
  int64_t work = 0, num_cpu_scalars = 0;
  auto widest = at::kBool;
  size_t at = 0;
  auto convert = [&](const at::Tensor& tensor) {
    if (!tensor.defined()) return tensor;
    work = std::max(work, tensor.numel());
    if (at::isFloatingType(tensor.scalar_type()) && tensor.dim() > 0 &&
        (widest != at::kDouble || tensor.scalar_type() == at::kDouble))
      widest = tensor.scalar_type();
    else if (widest == at::kBool)
      widest = tensor.scalar_type();
    if (is_device(tensor)) {
      any_device = true;
      return aliases.cpu(tensor);
    }
    const bool is_index = indexes && schema.arguments()[at].name() == "indices";
    if (tensor.dim() == 0 && !kNoCpuScalars.count(name)) {
      num_cpu_scalars += tensor.unsafeGetTensorImpl()->is_wrapped_number() ? 0 : 1;
    } else if (is_index) {
      // index has copied its indices already, in its shape function.
      if (name != "index") report(2, "index on CPU", tensor.nbytes(), tensor.numel(), 0);
    } else if (tensor.dim() > 0 || kNoCpuScalars.count(name)) {
      mixed = schema.arguments()[at].name();
    }
    return tensor;
  };
  for (; at < num_args; ++at) {
    const auto& value = originals[at];
    if (value.isTensor()) {
      converted.emplace_back(convert(value.toTensor()));
    } else if (value.isTensorList()) {
      c10::List<at::Tensor> list;
      for (const at::Tensor& tensor : value.toTensorList()) list.push_back(convert(tensor));
      converted.emplace_back(std::move(list));
    } else if (value.isOptionalTensorList()) {
      c10::List<std::optional<at::Tensor>> list;
      for (const std::optional<at::Tensor>& tensor : value.toOptionalTensorList())
        list.push_back(tensor ? std::optional<at::Tensor>(convert(*tensor)) : std::nullopt);
      converted.emplace_back(std::move(list));
    } else if (value.isDevice()) {
      any_device |= value.toDevice().type() == kPretend;
      converted.emplace_back(Device(DeviceType::CPU));
    } else {
      TORCH_CHECK(!strict || !value.isGenerator() ||
                      value.toGenerator().device().type() == kPretend,
                  "Expected a 'pretend' device type for generator but found 'cpu' (", name, ")");
      converted.push_back(value);
    }
  }
  if (strict && any_device) {
    TORCH_CHECK(mixed.empty(), "Expected all tensors to be on the same device, but found at least "
                "two devices, pretend:0 and cpu! (argument ", mixed, " of ", name, ")");
    TORCH_CHECK(!(kNoIntegers.count(name) && at::isIntegralType(widest, true)),
                "\"", name, "_cuda\" not implemented for '", toString(widest), "'");
    if (num_cpu_scalars) report(5, name.c_str(), 0, num_cpu_scalars, 0);
  }
  const int dtype = static_cast<int>(widest);
  if (name.find("index_put") != std::string::npos) {
    const auto& indices = originals[1].toOptionalTensorList();
    const auto& values = originals[2].toTensor();
    for (const std::optional<at::Tensor>& index : indices)
      if (index && index->defined() && (index->scalar_type() == at::kBool)) {
        if (values.numel() != 1) report(4, "index_put of a mask", index->nbytes(), index->numel(), 0);
        // A number is a CPU scalar in CUDA, and costs nothing.
        else if (is_device(values) && values.dim()) report(3, "index_put of a mask", 8, 1, 0);
      }
  }
  // CUDA has one driver of least squares, which needs full rank.
  if (name == "linalg_lstsq" && any_device) converted[3] = IValue(std::string("gels"));
  if (name == "segment_reduce" && !originals[6].toBool()) {
    // Without unsafe=True it reads the least length, and whether their sum is the number of values.
    report(4, "segment_reduce", 0, work, dtype);
    report(4, "segment_reduce", 0, work, dtype);
  }
  if (kSynchronizing.count(name)) {
    const bool sized = name == "repeat_interleave" && !originals.back().isNone();
    report(sized ? 0 : 4, name.c_str(), 0, work, dtype);
  }
  torch::jit::drop(*stack, num_args);
  torch::jit::Stack inner(converted);
  op.redispatchBoxed(c10::DispatchKeySet(c10::DispatchKey::CPU), &inner);

  for (size_t i = 0; i < num_args; ++i) {
    const auto* info = schema.arguments()[i].alias_info();
    if (!info || !info->isWrite()) continue;
    if (originals[i].isTensor() && is_device(originals[i].toTensor())) {
      aliases.take_back(originals[i].toTensor(), converted[i].toTensor());
    } else if (originals[i].isTensorList()) {
      const auto before = originals[i].toTensorList(), after = converted[i].toTensorList();
      for (size_t j = 0; j < before.size(); ++j)
        if (is_device(before.get(j))) aliases.take_back(before.get(j), after.get(j));
    }
  }
  const auto& returns = schema.returns();
  for (size_t r = 0; r < inner.size(); ++r) {
    const auto* info = r < returns.size() ? returns[r].alias_info() : nullptr;
    bool done = false;
    if (info && info->isWrite()) {
      for (size_t i = 0; i < num_args && !done; ++i) {
        const auto* from = schema.arguments()[i].alias_info();
        if (from && from->isWrite() && *from == *info) {
          stack->push_back(originals[i]);
          done = true;
        }
      }
    }
    if (done) continue;
    TORCH_CHECK(!info, "pretend: ", op.operator_name(), " returns a view; register it.");
    const auto& value = inner[r];
    if (any_device && value.isTensor() && value.toTensor().defined()) {
      work = std::max(work, value.toTensor().numel());
      stack->emplace_back(aliases.device(value.toTensor()));
    } else if (any_device && value.isTensorList()) {
      c10::List<at::Tensor> list;
      for (const at::Tensor& tensor : value.toTensorList())
        list.push_back(tensor.defined() ? aliases.device(tensor) : tensor);
      stack->emplace_back(std::move(list));
    } else {
      stack->push_back(value);
    }
  }
  report(0, name.c_str(), 0, work, dtype);
}

at::Tensor empty(c10::IntArrayRef size, std::optional<at::ScalarType> dtype,
                 std::optional<at::Layout>, std::optional<Device>, std::optional<bool>,
                 std::optional<at::MemoryFormat> format) {
  return at::detail::empty_generic(size, &allocator, c10::DispatchKeySet(c10::DispatchKey::PrivateUse1),
                                   c10::dtype_or_default(dtype), format);
}

at::Tensor empty_strided(c10::IntArrayRef size, c10::IntArrayRef stride,
                         std::optional<at::ScalarType> dtype, std::optional<at::Layout>,
                         std::optional<Device>, std::optional<bool>) {
  return at::detail::empty_strided_generic(
      size, stride, &allocator, c10::DispatchKeySet(c10::DispatchKey::PrivateUse1),
      c10::dtype_or_default(dtype));
}

at::Tensor copy_from(const at::Tensor& from, const at::Tensor& to, bool non_blocking) {
  Aliases aliases;
  const bool a = is_device(from), b = is_device(to);
  const auto dtype = static_cast<int>(to.scalar_type());
  report(a && b ? 0 : a ? 1 : 2, "copy", from.nbytes(), std::max(from.numel(), to.numel()), dtype);
  (b ? aliases.cpu(to) : to).copy_(a ? aliases.cpu(from) : from);
  return to;
}

at::Tensor copy_and_resize(const at::Tensor& from, const at::Tensor& to) {
  to.resize_(from.sizes());
  return copy_from(from, to, false);
}

at::Scalar local_scalar(const at::Tensor& tensor) {
  report(3, "item", tensor.nbytes(), 1, static_cast<int>(tensor.scalar_type()));
  Aliases aliases;
  return aliases.cpu(tensor).item();
}

at::Tensor& set_storage(at::Tensor& self, at::Storage source, int64_t offset, at::IntArrayRef size,
                        at::IntArrayRef stride) {
  return at::native::set_storage_cpu_(self, std::move(source), offset, size, stride);
}

// Convolutions of other devices do not reach the fallback. CUDA has none of integers.
at::Tensor convolution(const at::Tensor& input, const at::Tensor& weight,
                       const std::optional<at::Tensor>& bias, c10::SymIntArrayRef stride,
                       c10::SymIntArrayRef padding, c10::SymIntArrayRef dilation, bool transposed,
                       c10::SymIntArrayRef output_padding, c10::SymInt groups) {
  TORCH_CHECK(!at::isIntegralType(input.scalar_type(), true),
              "\"slow_conv2d_cuda\" not implemented for '", toString(input.scalar_type()), "'");
  Aliases aliases;
  std::optional<at::Tensor> no_bias;
  if (bias && bias->defined()) no_bias = aliases.cpu(*bias);
  report(0, "convolution", 0, input.numel(), static_cast<int>(input.scalar_type()));
  return aliases.device(at::convolution_symint(aliases.cpu(input), aliases.cpu(weight), no_bias, stride,
                                               padding, dilation, transposed, output_padding, groups));
}

TORCH_LIBRARY_IMPL(_, PrivateUse1, m) {
  m.fallback(torch::CppFunction::makeFromBoxedFunction<&fallback>());
}

TORCH_LIBRARY_IMPL(aten, PrivateUse1, m) {
  m.impl("empty.memory_format", TORCH_FN(empty));
  m.impl("empty_strided", TORCH_FN(empty_strided));
  m.impl("_copy_from", TORCH_FN(copy_from));
  m.impl("_copy_from_and_resize", TORCH_FN(copy_and_resize));
  m.impl("_local_scalar_dense", TORCH_FN(local_scalar));
  m.impl("as_strided", TORCH_FN(at::native::as_strided_tensorimpl));
  m.impl("view", TORCH_FN(static_cast<at::Tensor (*)(const at::Tensor&, at::IntArrayRef)>(at::native::view)));
  m.impl("view.dtype", TORCH_FN(at::native::view_dtype));
  m.impl("_reshape_alias", TORCH_FN(at::native::_reshape_alias));
  m.impl("unfold", TORCH_FN(at::native::unfold));
  m.impl("convolution_overrideable", TORCH_FN(convolution));
  m.impl("view_as_real", TORCH_FN(at::native::view_as_real));
  m.impl("view_as_complex", TORCH_FN(at::native::view_as_complex));
  m.impl("resize_", TORCH_FN(at::native::resize_));
  m.impl("set_.source_Storage", TORCH_FN(static_cast<at::Tensor& (*)(at::Tensor&, at::Storage)>(at::native::set_)));
  m.impl("set_.source_Storage_storage_offset", TORCH_FN(set_storage));
  m.impl("set_.source_Tensor", TORCH_FN(at::native::set_tensor_));
}

}  // namespace

extern "C" {
void pretend_register() {
  static bool done = false;
  if (!done) at::RegisterPrivateUse1HooksInterface(new Hooks());
  done = true;
}
void pretend_hook(Hook given) { hook = given; }
void pretend_strict(int on) { strict = on != 0; }
int64_t pretend_live() { return live; }
int64_t pretend_peak(int reset) {
  if (reset) peak = live.load();
  return peak;
}
}
