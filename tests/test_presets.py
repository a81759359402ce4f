"""Presets agree with their facts, and every wrong file or override gets one clear line."""

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cachesim import presets
from cachesim.config import Gpu
from traces.errors import InputError

KIB, MIB = 1 << 10, 1 << 20

#: SMs, warps per SM, L1 KiB per unit, units, L1 sets, L2 KiB, slices, L2 sets of one slice.
FACTS = {
    "titan-x-pascal": (28, 64, 24, 2, 4, 3072, 24, 64),
    "titan-x-pascal-gpgpusim": (28, 64, 48, 1, 4, 3072, 24, 64),
    "quadro-p4000": (14, 64, 24, 2, 4, 2048, 16, 64),
    "rtx-2060": (30, 32, 64, 1, 4, 3072, 24, 64),
    "rtx-2060-gpgpusim": (30, 32, 64, 1, 4, 3072, 24, 64),
    "rtx-2080-ti": (68, 32, 64, 1, 4, 5632, 44, 64),
    "rx-5700-xt": (40, 40, 16, 1, 32, 4096, 16, 128),
    "rx-6900-xt": (80, 32, 16, 1, 32, 4096, 16, 128),
    "h100-sxm": (132, 64, 212, 1, 4, 51200, 80, 128),
    "h200": (132, 64, 212, 1, 4, 61440, 96, 128),
}
every_preset = pytest.mark.parametrize("name", sorted(FACTS))


def test_the_shipped_presets_are_those_of_the_facts() -> None:
    assert presets.names() == sorted(FACTS)


@every_preset
def test_a_preset_has_the_totals_of_its_card(name: str) -> None:
    gpu = presets.load(name)
    sets = gpu.l1.num_sets, gpu.l2.num_sets
    assert (
        gpu.sm.count,
        gpu.sm.max_warps,
        gpu.l1.capacity / KIB,
        gpu.l1.units_per_sm,
        sets[0],
        gpu.l2.capacity / KIB,
        gpu.l2.num_slices,
        sets[1],
    ) == FACTS[name]


@every_preset
def test_every_field_has_a_source_and_a_confidence(name: str) -> None:
    entries = presets.sources(name)
    assert set(entries) == set(_leaves(presets.load(name)))
    for field, entry in entries.items():
        assert entry.source.strip(), field
        assert entry.confidence in presets.CONFIDENCES, field
        assert (entry.confidence == "?") == entry.source.startswith("assumed"), field
        assert entry.source != "assumed: the model's default", f"{field} is not in the file"


def _leaves(gpu: Gpu) -> list[str]:
    """The field paths of a GPU, from its own dump."""
    paths = []
    for key, value in gpu.model_dump(exclude_none=True).items():
        paths += [f"{key}.{field}" for field in value] if isinstance(value, dict) else [key]
    return paths


@every_preset
def test_a_preset_fits_on_three_screens_and_says_what_it_is(name: str) -> None:
    """One for what counting needs, two for the header and for what timing needs besides."""
    lines = (
        (Path(presets.__file__).parent / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    )
    assert len(lines) <= 3 * 72
    tables = lines[lines.index("") : lines.index("[sm_timing]")]
    assert len(tables) <= 72
    assert lines[0].startswith(("# NVIDIA ", "# AMD "))
    assert presets.load(name).name == name


def test_gpgpusim_presets_carry_the_strings_of_their_configs() -> None:
    titan, rtx = (presets.load(f"{n}-gpgpusim") for n in ("titan-x-pascal", "rtx-2060"))
    assert titan.l1_texture is not None and rtx.l1_texture is not None
    geometries = [
        (level.num_sets, level.line_bytes, level.ways, level.sector_bytes, level.write_allocate)
        for level in (titan.l1, titan.l1_texture, rtx.l1, rtx.l1_texture)
    ]
    assert geometries == [
        (4, 128, 96, 32, "none"),  # S:4:128:96,L:L:s:N:L
        (16, 128, 24, 128, "none"),  # N:16:128:24,L:R:m:N:L
        (4, 128, 128, 32, "lazy-fetch-on-read"),  # S:4:128:64,L:T:m:L:L at 64 KiB
        (4, 128, 256, 128, "none"),  # N:4:128:256,L:R:m:N:L
    ]
    assert (titan.l1.bypass_loads, rtx.l1.bypass_loads) == (True, False)
    assert (titan.l2.partition_hash, rtx.l2.partition_hash) == ("random", "linear")
    for gpu in (titan, rtx):
        assert (gpu.lane_address_path, gpu.texture_layout) == ("global", "gpgpusim")
        assert gpu.l2.set_hash == "ipoly"
        assert gpu.l1.write_policy in ("local-write-back", "write-through")


def test_only_the_gpgpusim_presets_have_a_texture_l1_of_their_own() -> None:
    for name in presets.names():
        gpu = presets.load(name)
        assert (gpu.l1_texture is not None) == name.endswith("-gpgpusim")
        assert (gpu.lane_address_path == "readonly") == (not name.endswith("-gpgpusim"))


def test_rdna_has_a_gl1_per_shader_array_and_navi_21_an_infinity_cache() -> None:
    navi10, navi21 = presets.load("rx-5700-xt"), presets.load("rx-6900-xt")
    for gpu, arrays in ((navi10, 4), (navi21, 8)):
        assert gpu.gl1 is not None
        assert gpu.gl1.capacity == 128 * KIB
        assert gpu.sm.count == arrays * gpu.gl1.sms_per_instance
        levels = (gpu.l1, gpu.gl1, gpu.l2)
        assert {(lv.line_bytes, lv.sector_bytes) for lv in levels} == {(128, 128)}
    assert navi10.llc is None
    assert navi21.llc is not None
    assert (navi21.llc.capacity, navi21.llc.sector_bytes) == (128 * MIB, 64)


def test_the_documented_way_back_to_the_rtx_2060_file_of_2020_works() -> None:
    path = Path(presets.__file__).parent / "rtx-2060-gpgpusim.toml"
    overrides = re.findall(r"--set (\S+)", path.read_text(encoding="utf-8"))
    gpu = presets.load("rtx-2060-gpgpusim", overrides)
    assert (gpu.l1.num_sets, gpu.l1.ways, gpu.l1.capacity) == (1, 512, 64 * KIB)
    assert (gpu.l1.write_policy, gpu.l1.write_allocate) == ("local-write-back", "none")


# ---- overrides and axes


def test_overrides_change_fields_that_only_fit_together() -> None:
    gpu = presets.load("titan-x-pascal")
    changed = presets.apply_overrides(
        gpu, ["l1.capacity=33 KiB", "l1.ways=66", "l1.units_per_sm=1"]
    )
    assert (changed.l1.capacity, changed.l1.ways, changed.l1.num_sets) == (33 * KIB, 66, 4)
    assert changed.l2 == gpu.l2
    with pytest.raises(InputError, match=r"l1\.capacity = 33792 B is not a multiple"):
        presets.apply_overrides(gpu, ["l1.capacity=33 KiB"])


def test_overrides_are_typed() -> None:
    gpu = presets.load(
        "rx-5700-xt",
        ["sm.warp_size=64", "l1.bypass_loads=true", "l1.replacement=srrip", "clock_hz=1000000000"],
    )
    assert (gpu.sm.warp_size, gpu.l1.bypass_loads) == (64, True)
    assert (gpu.l1.replacement, gpu.clock_hz) == ("srrip", 10**9)


def test_the_last_of_several_overrides_of_a_field_wins() -> None:
    gpu = presets.load("rtx-2060", ["l1.ways=64", "l1.ways=32"])
    assert gpu.l1.ways == 32
    assert presets.load("rx-6900-xt", ["llc=none", "llc.ways=8", "llc=none"]).llc is None


@pytest.mark.parametrize(
    ("name", "level"),
    [("rx-6900-xt", "gl1"), ("rx-6900-xt", "llc"), ("rtx-2060-gpgpusim", "l1_texture")],
)
def test_a_level_is_taken_out_by_an_override(name: str, level: str) -> None:
    assert getattr(presets.load(name), level) is not None
    assert getattr(presets.load(name, [f"{level}=none"]), level) is None


def test_a_level_may_be_added_whole() -> None:
    llc = presets.load("rx-6900-xt").llc
    assert llc is not None
    fields = {f"llc.{field}": value for field, value in llc.model_dump().items()}
    assert presets.with_fields(presets.load("rx-5700-xt"), fields).llc == llc


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("l1.capacity", "override 'l1.capacity': allowed is FIELD=VALUE"),
        ("l1.capacity=", "allowed is FIELD=VALUE"),
        ("l1.capacty=1KiB", r"unknown field in \[l1\] 'capacty'; did you mean 'capacity'\? choose"),
        ("capacity=1KiB", r"unknown field 'capacity'; did you mean '\w+\.capacity'\? choose"),
        ("l3.ways=4", r"unknown field 'l3\.ways'; did you mean 'l[12]\.ways'\? choose from name"),
        ("l1=none", "'l1' is a table; choose one of its fields: capacity, line_bytes"),
        ("llc=8", "'llc' is a table"),
        ("l1.capacity=48KB", "l1.capacity: '48KB' is not a size; allowed units are B, KiB"),
        ("l1.ways=four", "l1.ways = 'four'; allowed are whole numbers"),
        ("l1.ways=-4", "l1.ways = '-4'; allowed are numbers above 0"),
        ("sm.count=5000", "sm.count = '5000'; allowed are numbers up to 4096"),
        (
            "l1.replacement=lur",
            r"l1.replacement = 'lur'; did you mean 'lru'\? allowed are lru, fifo",
        ),
        ("sm.warp_size=48", "sm.warp_size = '48'; allowed are 32, 64"),
        ("l1.bypass_loads=maybe", "l1.bypass_loads = 'maybe'; allowed are true, false"),
        ("texture_layout=mortn", r"unknown texture_layout 'mortn'; did you mean 'morton'\?"),
        (
            "l1.sector_bytes=256",
            "rtx-2060 with l1.sector_bytes=256: l1.sector_bytes = 256 does not",
        ),
        ("llc.ways=4", r"rtx-2060 with llc\.ways=4: missing llc\.capacity, llc\.line_bytes"),
        ("gl1.ways=65\n", None),
    ],
)
def test_a_wrong_override_gets_one_line(override: str, message: str | None) -> None:
    with pytest.raises(InputError, match=message) as raised:
        presets.load("rtx-2060", [override])
    assert "\n" not in str(raised.value)


def test_an_axis_is_a_field_and_typed_values() -> None:
    assert presets.parse_axis("l1.capacity=16KiB, 32KiB,64KiB") == (
        "l1.capacity",
        [16384, 32768, 65536],
    )
    assert presets.parse_axis("l2.replacement=lru,srrip") == ("l2.replacement", ["lru", "srrip"])
    assert presets.parse_axis("sm.warp_size=32,64") == ("sm.warp_size", [32, 64])
    assert presets.parse_axis("l1.bypass_loads=true") == ("l1.bypass_loads", [True])


@given(st.lists(st.integers(1, 1 << 30), min_size=1, max_size=5, unique=True))
def test_axis_values_set_what_they_say(ways: list[int]) -> None:
    field, values = presets.parse_axis(f"l1.ways={','.join(map(str, ways))}")
    assert (field, values) == ("l1.ways", ways)


@pytest.mark.parametrize(
    ("axis", "message"),
    [
        ("l1.capacity", "allowed is FIELD=VALUE,VALUE"),
        ("l1.capacity=16KiB,,32KiB", "allowed is FIELD=VALUE,VALUE"),
        ("l1.capacity=16KiB,16384", "axis .*: 16384 stands there twice"),
        ("l1.capcity=16KiB", r"did you mean 'capacity'\?"),
        ("l1.capacity=16KB", "'16KB' is not a size"),
        ("texture_layout=linear", "unknown texture_layout 'linear'; .*choose from"),
    ],
)
def test_a_wrong_axis_gets_one_line(axis: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        presets.parse_axis(axis)
    assert "\n" not in str(raised.value)


# ---- a user's own files


def write(folder: Path, text: str, name: str = "mine.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_extends_a_preset_and_keeps_its_sources(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """
        extends = "rtx-2080-ti"
        [l1]
        capacity = "32 KiB"
        ways = { value = 64, source = "a datasheet", confidence = "R" }
        """,
    )
    gpu, base = presets.load(path), presets.load("rtx-2080-ti")
    assert (gpu.name, gpu.l1.capacity, gpu.l1.ways) == ("mine", 32 * KIB, 64)
    assert (gpu.l2, gpu.sm) == (base.l2, base.sm)
    entries = presets.sources(path)
    assert entries["l1.ways"] == presets.Sourced(64, "a datasheet", "R")
    assert entries["l1.capacity"] == presets.Sourced(32 * KIB, "assumed: given in mine.toml", "?")
    assert entries["l2.capacity"] == presets.sources("rtx-2080-ti")["l2.capacity"]


def test_files_extend_files_and_drop_levels(tmp_path: Path) -> None:
    write(tmp_path, 'extends = "rx-6900-xt"\nname = "Big Navi"\nllc = "none"', "parent.toml")
    (tmp_path / "sub").mkdir()
    child = write(tmp_path / "sub", 'extends = "../parent.toml"\nl2.capacity = "8 MiB"')
    gpu = presets.load(str(child))
    assert (gpu.name, gpu.llc, gpu.l2.capacity) == ("mine", None, 8 * MIB)
    assert presets.load(tmp_path / "parent.toml").name == "Big Navi"


def test_a_file_may_stand_alone_and_take_defaults(tmp_path: Path) -> None:
    lines = ['vendor = "other"', "clock_hz = 1000000000", 'texture_layout = "row-major"']
    for section, fields in presets.load("rtx-2060").model_dump(exclude_none=True).items():
        if isinstance(fields, dict):
            kept = {k: v for k, v in fields.items() if k != "bypass_loads"}
            kept = {k: str(v).lower() if isinstance(v, bool) else repr(v) for k, v in kept.items()}
            lines += [f"[{section}]", *(f"{key} = {value}" for key, value in kept.items())]
    path = write(tmp_path, "\n".join(lines))
    assert presets.load(path).l1.bypass_loads is False
    assert presets.sources(path)["l1.bypass_loads"].source == "assumed: the model's default"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("l1 = [", r"mine\.toml: not TOML: .*line 1"),
        ('a = 1\nb = "x', r"mine\.toml: not TOML: .*line 2"),
        (
            'extends = "rtx-2080"',
            r"mine\.toml: extends: unknown preset 'rtx-2080'; did you mean 'rtx",
        ),
        ("extends = 7", r"mine\.toml: extends = 7; allowed is a preset's name"),
        ('extends = "gone.toml"', r"gone\.toml: No such file or directory"),
        ('extends = "mine.toml"', r"cannot extend itself: mine\.toml -> mine\.toml"),
        (
            "l1.capacty = 4",
            r"mine\.toml: unknown field in \[l1\] 'capacty'; did you mean 'capacity'",
        ),
        ("[l3]\nways = 4", r"mine\.toml: unknown field 'l3'; did you mean 'l[12]'\?"),
        ("l1 = 4", r"mine\.toml: l1 = 4; allowed is a table \[l1\]$"),
        ('l1 = "none"', r"mine\.toml: l1 = 'none'; allowed is a table \[l1\]$"),
        ("llc = 4", r"mine\.toml: llc = 4; allowed is a table \[llc\] or 'none'"),
        (
            'l1.capacity = "48 KB"',
            r"mine\.toml: l1\.capacity: '48 KB' is not a size; allowed units",
        ),
        ("l1.capacity = 4.5", r"mine\.toml: l1\.capacity: 4\.5 is not a size"),
        ("l1.capacity = -1", r"mine\.toml: l1\.capacity = -1; allowed are numbers above 0"),
        ("l1.ways = 4.5", r"mine\.toml: l1\.ways = 4\.5; allowed are whole numbers"),
        ("l1.ways = true", r"mine\.toml: l1\.ways: True is not a whole number"),
        ("l1.ways = [4]", r"mine\.toml: l1\.ways = \[4\]; allowed are whole numbers"),
        ("name = 5", r"mine\.toml: name = 5; allowed is text"),
        ('l1.bypass_loads = "x"', r"mine\.toml: l1\.bypass_loads = 'x'; allowed are true, false"),
        ("l1.sector_bytes = 48", r"mine\.toml: l1\.sector_bytes = 48: allowed are powers of two"),
        ("l1.line_bytes = 96", r"mine\.toml: l1\.line_bytes = 96: allowed are powers of two"),
        ("l2.ways = 0\nl1.ways = 0", r"l1\.ways = 0; allowed are numbers above 0 \(and 1 more\)"),
        ('texture_layout = "mortn"', r"mine\.toml: unknown texture_layout 'mortn'; did you mean"),
        ("l1.ways = {}", r"mine\.toml: l1\.ways: missing value; it needs value, source, conf"),
        ("l1.ways = { value = 4 }", r"mine\.toml: l1\.ways: missing source"),
        ("l1.ways = { valeu = 4 }", r"l1\.ways: unknown key 'valeu'; did you mean 'value'\?"),
        (
            'l1.ways = { value = 4, source = "x", confidence = "X" }',
            r"l1\.ways: confidence = 'X'; allowed are S, M, P, R, D, \?",
        ),
        (
            'l1.ways = { value = 4, source = " ", confidence = "S" }',
            r"l1\.ways: source = ' '; allowed is text that is not empty",
        ),
        (
            'l1.ways = { value = 4, source = "a guess", confidence = "?" }',
            r"l1\.ways: confidence = '\?' with source = 'a guess'; .* go together",
        ),
        (
            'l1.ways = { value = 4, source = "assumed: 4", confidence = "S" }',
            r"l1\.ways: confidence = 'S' with source = 'assumed: 4'",
        ),
    ],
)
def test_a_wrong_file_gets_one_line(tmp_path: Path, text: str, message: str) -> None:
    if "extends" not in text and "not TOML" not in message:
        text = f'extends = "rtx-2060"\n{text}'
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=message) as raised:
        presets.load(path)
    assert "\n" not in str(raised.value)


def test_a_file_without_a_base_is_told_all_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"mine\.toml: missing vendor, clock_hz, .*, l1, l2, dram$"
    ):
        presets.load(write(tmp_path, "# nothing yet"))


def test_a_cycle_over_two_files_is_shown(tmp_path: Path) -> None:
    write(tmp_path, 'extends = "b.toml"', "a.toml")
    write(tmp_path, 'extends = "a.toml"', "b.toml")
    with pytest.raises(InputError, match=r"itself: a\.toml -> b\.toml -> a\.toml"):
        presets.load(tmp_path / "a.toml")


def test_what_is_no_preset_and_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"unknown preset 'titan-x'; did you mean 'titan-x-pascal'\? .*toml$"
    ):
        presets.load("titan-x")
    with pytest.raises(InputError, match=r"gone\.toml: No such file or directory"):
        presets.load(tmp_path / "gone.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(InputError, match=r"folder\.toml: Is a directory"):
        presets.load(tmp_path / "folder.toml")
    (tmp_path / "binary.toml").write_bytes(b"name = \xff")
    with pytest.raises(InputError, match=r"binary\.toml: not UTF-8 text: .* at byte 7"):
        presets.load(tmp_path / "binary.toml")


# ---- tables


def test_describe_lists_every_field_with_units_and_overrides() -> None:
    table = presets.describe("rtx-2080-ti", ["l1.capacity=32KiB"]).set_index("field")
    assert list(table.columns) == ["value", "source", "confidence"]
    assert list(table.index) == list(presets.sources("rtx-2080-ti"))
    assert table.loc["l2.capacity", "value"] == "5.5 MiB"
    assert table.loc["l1.bypass_loads", "value"] == "false"
    assert tuple(table.loc["l1.capacity"]) == ("32 KiB", "assumed: set by an override", "?")


def test_diff_shows_exactly_the_fields_that_differ() -> None:
    table = presets.diff("rtx-2060", "rtx-2080-ti")
    assert list(table.columns) == ["field", "rtx-2060", "rtx-2080-ti"]
    counting = table[~table["field"].str.contains("timing")]
    assert counting.to_numpy().tolist() == [
        ["name", "rtx-2060", "rtx-2080-ti"],
        ["clock_hz", "1680000000", "1545000000"],
        ["sm.count", "30", "68"],
        ["l2.capacity", "3 MiB", "5.5 MiB"],
        ["l2.num_channels", "12", "22"],
    ]
    timing = table[table["field"] == "l2_timing.clock_hz"].to_numpy().tolist()
    assert timing == [["l2_timing.clock_hz", "1680000000", "1545000000"]]
    assert presets.diff("rtx-2060", "rtx-2060").empty


def test_diff_says_none_for_a_level_that_one_side_lacks() -> None:
    table = presets.diff("rx-5700-xt", "rx-6900-xt").set_index("field")
    assert tuple(table.loc["llc.capacity"]) == ("none", "128 MiB")
