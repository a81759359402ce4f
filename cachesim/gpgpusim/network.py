"""The table `icnt` of a preset: the built-in crossbar or BookSim's, whose file stands beside."""

from __future__ import annotations

from cachesim.gpgpusim.cache_string import SECTOR_BYTES
from cachesim.gpgpusim.geometry import L1_STRING, data_cache, texture_cache
from cachesim.gpgpusim.options import Options, Remark, label
from cachesim.gpgpusim.syntax import Setting, read_network_file
from cachesim.presets.files import Sourced

Fields = dict[str, Sourced]

HEADER_BYTES = 8
#: One router's pipeline, there and back; the crossbar's own transfer is a cycle more.
BOOKSIM_CYCLES = 5
_FILE = "-inter_config_file"
_MODES = {
    "1": "BookSim: an input sends one packet in a cycle at most",
    "2": "the built-in crossbar: an input may send to one output after the other in a cycle",
}
#: BookSim's own values where a file has none; 0 takes them, too.
_BOOKSIM_DEFAULTS = {
    "flit_size": 32,
    "num_vcs": 16,
    "vc_buf_size": 8,
    "input_buffer_size": 9,
    "ejection_buffer_size": 0,
    "boundary_buffer_size": 16,
    "internal_speedup": 1,
}


def icnt(options: Options) -> Fields:
    """The fields of `icnt`.

    Raises:
        InputError: an option's value is wrong, or the network's file is no such file.
    """
    options.choice("-network_mode", _MODES)
    mode = options.setting("-network_mode").text
    own = _crossbar(options) if mode == "2" else _booksim(options)
    ejection = "-gpgpu_n_cluster_ejection_buffer_size"
    response = "-gpgpu_n_ldst_response_buffer_size"
    fields = {
        "queueing": options.sourced("input-fifo", "-network_mode", f" {mode}: inputs are FIFOs"),
        **own,
        "header_bytes": Sourced(HEADER_BYTES, "GPGPU-Sim's READ_PACKET_SIZE", "S"),
        "ejection_packets": options.sourced(options.number(ejection, 1, 1 << 16), ejection),
        "response_packets": options.sourced(options.number(response, 1, 1 << 16), response),
    }
    return {f"icnt.{field}": entry for field, entry in fields.items()}


def network_remarks(options: Options) -> list[Remark]:
    """What of the network has no counterpart in a preset."""
    remarks = []
    clocks = options.clocks_hz()
    if clocks[1] != clocks[0]:
        setting = options.setting("-gpgpu_clock_domains")
        remarks.append(Remark(setting, "the interconnect runs at the cores' clock"))
    cores = options.setting("-gpgpu_n_cores_per_cluster")
    if options.number(cores.option, 1) > 1:
        remarks.append(Remark(cores, "every SM has its own port to the interconnect"))
    if options.setting("-network_mode").text == "1":
        file = _network_settings(options)
        if file is None:
            remarks.append(
                Remark(options.setting(_FILE), "there is no such file beside the config")
            )
        else:
            stages = file.get("n", Setting("n", "1"))
            if stages.text != "1":
                remarks.append(Remark(stages, "the network is one crossbar"))
            topology = file.get("topology", Setting("topology", "torus"))
            if topology.text != "fly":
                remarks.append(Remark(topology, "the network is one crossbar"))
    return remarks


def _crossbar(options: Options) -> Fields:
    """The built-in crossbar: a packet takes one cycle whatever its size."""
    into, out, flit = "-icnt_in_buffer_limit", "-icnt_out_buffer_limit", "-icnt_flit_size"
    flit_bytes = options.number(flit, 1, 1 << 20)
    largest = HEADER_BYTES + _largest_reply(options)
    no_delay = Sourced(0, "local_interconnect.cc: a packet that wins its output is there", "S")
    flit_entry = options.sourced(flit_bytes, flit)
    if largest > flit_bytes:
        flit_entry = Sourced(
            largest,
            "local_interconnect.cc: a packet of any size takes one cycle; the largest is "
            f"{largest} B, {flit} {flit_bytes}",
            "D",
        )
    return {
        "router_steps": options.sourced(0, "-network_mode", f" 2, {_MODES['2']}"),
        "request_latency_cycles": no_delay,
        "reply_latency_cycles": no_delay,
        "flit_bytes": flit_entry,
        "input_packets": options.sourced(options.number(into, 1, 1 << 16), into),
        "output_packets": options.sourced(options.number(out, 1, 1 << 16), out),
    }


def _largest_reply(options: Options) -> int:
    """Bytes of data of the largest packet: a sector, or a line of a cache without sectors."""
    texture = texture_cache(options)
    sizes = [data_cache(options, L1_STRING).sector_bytes]
    return max(sizes + ([texture.sector_bytes] if texture else []))


def _booksim(options: Options) -> Fields:
    """BookSim's one-stage network, its buffers in packets of one sector."""
    file = _network_settings(options)
    number = {key: _network_number(file, key) for key in _BOOKSIM_DEFAULTS}
    name = options.setting(_FILE).text
    origin = f"{label(options.setting(_FILE))} {name}"
    flits = -(-(HEADER_BYTES + SECTOR_BYTES) // number["flit_size"])
    into = number["input_buffer_size"] + number["num_vcs"] * number["vc_buf_size"]
    out = number["num_vcs"] * number["vc_buf_size"] + number["boundary_buffer_size"]
    packets = f", {flits} flit{'s' * (flits > 1)} to a packet"

    def entry(value: int, source: str, grade: str) -> Sourced:
        if file is None:
            return Sourced(value, f"assumed: {name} not given, BookSim's default {source}", "?")
        return Sourced(value, f"{origin} {source}", grade)

    delay = Sourced(BOOKSIM_CYCLES, "counted over the stages of BookSim's router", "D")
    return {
        "router_steps": entry(
            number["internal_speedup"],
            f"internal_speedup {number['internal_speedup']}: an output is given in one step, its "
            "packet moves in the next",
            "S",
        ),
        "request_latency_cycles": delay,
        "reply_latency_cycles": delay,
        "flit_bytes": entry(number["flit_size"], "flit_size", "S"),
        "input_packets": entry(
            max(1, into // flits),
            f"input_buffer_size {number['input_buffer_size']} + vc_buf_size "
            f"{number['vc_buf_size']} x num_vcs {number['num_vcs']}{packets}",
            "D",
        ),
        "output_packets": entry(
            max(1, out // flits),
            f"vc_buf_size {number['vc_buf_size']} x num_vcs {number['num_vcs']} of credit + "
            f"boundary_buffer_size {number['boundary_buffer_size']}{packets}",
            "D",
        ),
    }


def _network_settings(options: Options) -> dict[str, Setting] | None:
    """The keys of the file that -inter_config_file names, if it stands beside the config."""
    setting = options.setting(_FILE)
    if setting.file is None or not (setting.file.parent / setting.text).is_file():
        return None
    return read_network_file(setting.file.parent / setting.text)


def _network_number(file: dict[str, Setting] | None, key: str) -> int:
    setting = (file or {}).get(key)
    if setting is None:
        return _BOOKSIM_DEFAULTS[key]
    if key == "internal_speedup":
        return _speedup(setting)
    least = 1 if key in ("flit_size", "num_vcs", "vc_buf_size") else 0
    if not (setting.text.isdecimal() and len(setting.text) < 7 and int(setting.text) >= least):
        raise setting.refuse(f"allowed are whole numbers from {least}")
    # BookSim takes 0 as "my default".
    return int(setting.text) or _BOOKSIM_DEFAULTS[key]


def _speedup(setting: Setting) -> int:
    """Steps of the router in a cycle: BookSim's file has a decimal, of which we take whole ones."""
    whole, _, fraction = setting.text.partition(".")
    if not (whole.isdecimal() and len(whole) == 1 and 1 <= int(whole) <= 8) or fraction.strip("0"):
        raise setting.refuse("allowed are whole numbers from 1 to 8")
    return int(whole)
