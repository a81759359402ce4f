"""The counting model's part of a preset: chip, SM, caches and memory atom from the options."""

from __future__ import annotations

from fractions import Fraction

from cachesim.gpgpusim.cache_string import CacheString, parse_cache_string
from cachesim.gpgpusim.options import Options, label
from cachesim.gpgpusim.syntax import Setting
from cachesim.presets.files import Sourced

Fields = dict[str, Sourced]

L1_STRING, TEXTURE_STRING, L2_STRING = "-gpgpu_cache:dl1", "-gpgpu_tex_cache:l1", "-gpgpu_cache:dl2"
_PARTITION_HASHES = {"0": "linear", "1": "xor", "2": "ipoly", "4": "random"}
_WARP_SIZES = (32, 64)


def geometry(options: Options, name: str) -> Fields:
    """The fields outside the timing tables.

    Raises:
        InputError: an option's value is wrong, or no preset can express it.
    """
    return {
        **_chip(options, name),
        **_sm(options),
        **_l1(options),
        **_l1_texture(options),
        **_l2(options),
        "dram.sector_bytes": _atom(options),
    }


def data_cache(options: Options, option: str) -> CacheString:
    """The L1's or the L2's string, which a preset needs.

    Raises:
        InputError: the string is wrong, or "none".
    """
    setting = options.setting(option)
    cache = parse_cache_string(setting)
    if cache is None:
        raise setting.refuse("a preset cannot do without this cache; allowed is a cache string")
    return cache


def texture_cache(options: Options) -> CacheString | None:
    """The texture L1's string; None where there is none."""
    return parse_cache_string(options.setting(TEXTURE_STRING), texture=True)


def _chip(options: Options, name: str) -> Fields:
    clocks = options.clocks_hz()
    text = options.setting("-gpgpu_clock_domains").text
    return {
        "name": Sourced(name, "the preset's own name", "D"),
        "vendor": Sourced("nvidia", "the maker of the card", "R"),
        "clock_hz": options.sourced(clocks[0], "-gpgpu_clock_domains", f" {text}"),
        "texture_layout": Sourced(
            "gpgpusim", "cuda-sim.cc bindTexture and instructions.cc tex_impl", "S"
        ),
        "lane_address_path": Sourced(
            "global", "Accel-Sim's trace mode: texel addresses arrive as plain LDG loads", "S"
        ),
    }


def _sm(options: Options) -> Fields:
    pipeline = "-gpgpu_shader_core_pipeline"
    setting = options.setting(pipeline)
    threads, warp_size = options.numbers(pipeline, ":", 2, 2)
    if warp_size not in _WARP_SIZES or threads % warp_size or not threads:
        raise setting.refuse("allowed is <threads>:<32 or 64>, whole warps of threads")
    clusters = options.number("-gpgpu_n_clusters", 1)
    cores = options.number("-gpgpu_n_cores_per_cluster", 1)
    each = "one core each" if cores == 1 else f"{cores} cores each"
    ctas, registers = "-gpgpu_shader_cta", "-gpgpu_shader_registers"
    return {
        "sm.count": options.sourced(clusters * cores, "-gpgpu_n_clusters", f", {each}"),
        "sm.max_warps": options.sourced(threads // warp_size, pipeline, f" {setting.text}"),
        "sm.max_ctas": options.sourced(options.number(ctas, 1), ctas),
        "sm.warp_size": options.sourced(warp_size, pipeline, f" {setting.text}"),
        "sm.registers": options.sourced(options.number(registers, 1), registers),
        "sm.shared": options.sourced(
            options.number("-gpgpu_shmem_size", 1),
            "-gpgpu_shmem_size",
            f" {options.setting('-gpgpu_shmem_size').text}",
        ),
    }


def _cache(options: Options, table: str, option: str, cache: CacheString) -> Fields:
    """Line to write policies, which the string itself says."""
    letters = cache.letters
    sectors = (
        "type S, four sectors a line"
        if cache.sector_bytes < cache.line_bytes
        else f"type {letters['sector_bytes']}, no sectors"
    )
    fields = {
        "line_bytes": options.sourced(cache.line_bytes, option),
        "sector_bytes": options.sourced(cache.sector_bytes, option, f": {sectors}"),
        "ways": options.sourced(cache.ways, option),
    }
    for field in ("replacement", "set_hash", "write_policy", "write_allocate"):
        fields[field] = options.sourced(getattr(cache, field), option, f": {letters[field]}")
    return {f"{table}.{field}": entry for field, entry in fields.items()}


def _l1(options: Options) -> Fields:
    cache = data_cache(options, L1_STRING)
    fields = _cache(options, "l1", L1_STRING, cache)
    text = f"{options.source(L1_STRING)} {cache.text}"
    fields["l1.capacity"] = Sourced(
        cache.capacity,
        f"{cache.num_sets} sets x {cache.ways} ways x {cache.line_bytes} B of {text}",
        "D",
    )
    if options.flag("-gpgpu_adaptive_cache_config"):
        ways, split = adaptive_ways(options, cache)
        capacity = cache.num_sets * ways * cache.line_bytes
        fields["l1.capacity"] = Sourced(capacity, split, "D")
        fields["l1.ways"] = Sourced(
            ways,
            f"{cache.ways} of {text} are for {_kib(cache.capacity)}; {_kib(capacity)} / "
            f"({cache.num_sets} sets x {cache.line_bytes} B)",
            "D",
        )
    skip = "-gpgpu_gmem_skip_L1D"
    fields["l1.units_per_sm"] = Sourced(1, "one L1D per core", "S")
    fields["l1.bypass_loads"] = options.sourced(
        options.flag(skip), skip, f" {int(options.flag(skip))}"
    )
    return fields


def adaptive_ways(options: Options, cache: CacheString) -> tuple[int, str]:
    """The L1's ways where no shared memory is in use, and the words for where they come from.

    Of the array that L1 and shared memory split, shared memory gets the smallest option there is
    (facts sheet section 3.5, adaptive L1).
    """
    unified = options.number("-gpgpu_unified_l1d_size", 1, 1 << 16)
    shared = min(options.numbers("-gpgpu_shmem_option", ",", 1))
    if shared >= unified:
        raise options.setting("-gpgpu_shmem_option").refuse(
            f"allowed are sizes in KB below -gpgpu_unified_l1d_size {unified}"
        )
    max_ways = (unified << 10) // (cache.num_sets * cache.line_bytes)
    ways = round(Fraction(max_ways * (unified - shared), unified))
    name = label(options.setting("-gpgpu_unified_l1d_size"))
    return ways, (
        f"{name} -gpgpu_unified_l1d_size {unified} less the {shared} of "
        f"-gpgpu_shmem_option {options.setting('-gpgpu_shmem_option').text}"
    )


def _kib(size_bytes: int) -> str:
    return f"{size_bytes / 1024:g} KiB"


def _l1_texture(options: Options) -> Fields:
    cache = texture_cache(options)
    if cache is None:
        return {}
    text = f"{options.source(TEXTURE_STRING)} {cache.text}"
    return {
        **_cache(options, "l1_texture", TEXTURE_STRING, cache),
        "l1_texture.capacity": Sourced(
            cache.capacity,
            f"{cache.num_sets} sets x {cache.ways} ways x {cache.line_bytes} B of {text}",
            "D",
        ),
        "l1_texture.units_per_sm": Sourced(1, "one L1T per core", "S"),
        "l1_texture.bypass_loads": Sourced(
            False, "texture fetches always look up the texture cache", "S"
        ),
    }


def _l2(options: Options) -> Fields:
    cache = data_cache(options, L2_STRING)
    channels = options.number("-gpgpu_n_mem", 1, 4096)
    slices = options.number("-gpgpu_n_sub_partition_per_mchannel", 1, 64)
    partition = options.setting("-gpgpu_memory_partition_indexing")
    partition_hash = options.choice(partition.option, _PARTITION_HASHES)
    if partition_hash == "xor" and channels & (channels - 1):
        raise partition.refuse(
            f"XOR over {channels} channels (-gpgpu_n_mem); allowed are powers of two"
        )
    first_bit, _ = address_map(options)
    name = label(options.setting("-gpgpu_mem_addr_mapping"))
    enum = " = RANDOM in the source's enum" if partition_hash == "random" else ""
    return {
        **_cache(options, "l2", L2_STRING, cache),
        "l2.capacity": Sourced(
            channels * slices * cache.capacity,
            f"{channels} x {slices} slices of {_kib(cache.capacity)}, from "
            f"{options.source(L2_STRING)} {cache.text}",
            "D",
        ),
        "l2.set_hash": options.sourced(
            cache.set_hash, L2_STRING, f": {cache.letters['set_hash']}, over {cache.num_sets} sets"
        ),
        "l2.num_channels": options.sourced(channels, "-gpgpu_n_mem"),
        "l2.slices_per_channel": options.sourced(slices, "-gpgpu_n_sub_partition_per_mchannel"),
        "l2.channel_interleave": Sourced(
            1 << first_bit, f"{name} -gpgpu_mem_addr_mapping: channels from bit {first_bit} on", "S"
        ),
        "l2.partition_hash": options.sourced(
            partition_hash, partition.option, f" {partition.text or 0}{enum}"
        ),
    }


def address_map(options: Options) -> tuple[int, str]:
    """The lowest address bit that chooses the channel, and the 64 letters of the other bits.

    A map with letters D names the channel's bits itself; where they are neighbours it is rewritten
    to the other form, which leaves them out.

    Raises:
        InputError: not a map of 64 bits, or channel bits that are not neighbours.
    """
    setting = options.setting("-gpgpu_mem_addr_mapping")
    head, _, tail = setting.text.partition(";")
    letters = "".join(letter for letter in (tail or head).upper() if letter not in ".| ")
    if len(letters) != 64 or set(letters) - set("DBRCS0"):
        raise setting.refuse("allowed is dramid@<bit>; and 64 letters of B, R, C, S, 0 (or D)")
    start = head.removeprefix("dramid@")
    if tail and start != head:
        if not (start.isdecimal() and len(start) < 3 and 4 <= int(start) < 40) or "D" in letters:
            raise setting.refuse("allowed is dramid@<bit 4 to 39>; without letters D")
        return int(start), _dotted(letters)
    return _explicit_channels(options, setting, letters)


def _explicit_channels(options: Options, setting: Setting, letters: str) -> tuple[int, str]:
    num_bits = letters.count("D")
    first_bit = len(letters) - 1 - letters.rfind("D") if num_bits else 0
    neighbours = "D" * num_bits in letters
    if not num_bits or not neighbours or 1 << num_bits != options.number("-gpgpu_n_mem"):
        raise setting.refuse(
            "allowed are letters D side by side, as many as -gpgpu_n_mem needs, or dramid@<bit>;"
        )
    return first_bit, _dotted("0" * num_bits + letters.replace("D", ""))


def _dotted(letters: str) -> str:
    return ".".join(letters[first : first + 8] for first in range(0, 64, 8))


def _atom(options: Options) -> Sourced:
    width = options.number("-gpgpu_dram_buswidth", 1, 1024)
    chips = options.number("-gpgpu_n_mem_per_ctrlr", 1, 64)
    burst = options.number("-gpgpu_dram_burst_length", 1, 1024)
    name = label(options.setting("-gpgpu_dram_buswidth"))
    wide = f"{width} B" if chips == 1 else f"{chips} x {width} B"
    return Sourced(width * chips * burst, f"{name}: bus width {wide} x burst length {burst}", "S")
