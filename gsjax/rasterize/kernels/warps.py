"""What a warp of 32 threads does together: read entries into shared memory, vote, and sum rows.

On a CPU, where one thread does the work of a warp, the same functions do it alone.
"""

# Warp's types are values.
# pyright: reportInvalidTypeForm=false

from functools import cache

import warp as wp

WARP = 32
WARPS = 4  # per block of threads
STAGED = 32  # entries read at a time
OPTIONS = {"fast_math": True, "enable_backward": False, "max_unroll": 64}


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffff, flag) != 0;
#else
    return flag;
#endif
""")
def in_any_lane(flag: bool) -> bool:
    """Whether the flag is set in any thread of the warp."""
    ...


@cache
def reader(fours: int):
    """`read(stage, records, ids, first, end, lane, j, part)`: four of the numbers of entry `first + j`.

    First, with `stage`, it copies entries `first`, `first + 1`, ... to the warp's part of shared memory.
    Entries from `end` on are transparent.
    """
    snippet = f"""
    const float nothing = -1e30f;  // as the logarithm of an opacity, the sixth number
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[{WARPS}][{STAGED}][{fours}];
    float4 (*own)[{fours}] = staged[threadIdx.x / {WARP}];
    if (stage) {{
        __syncwarp();
        const bool there = first + lane < end;
        const size_t row = there ? size_t(ids.data[first + lane]) * {fours} : 0;
        const float4* from = reinterpret_cast<const float4*>(records.data) + row;
        #pragma unroll
        for (int i = 0; i < {fours}; ++i)
            own[lane][i] = there ? from[i] : make_float4(0.0f, i == 1 ? nothing : 0.0f, 0.0f, 0.0f);
        __syncwarp();
        return wp::vec4();
    }}
    const float4 four = own[j][part];
    return wp::vec4(four.x, four.y, four.z, four.w);
#else
    if (stage) return wp::vec4();
    if (first + j >= end) return wp::vec4(0.0f, part == 1 ? nothing : 0.0f, 0.0f, 0.0f);
    const float* from = records.data + (size_t(ids.data[first + j]) * {fours} + part) * 4;
    return wp::vec4(from[0], from[1], from[2], from[3]);
#endif
"""

    @wp.func_native(snippet)
    def read(
        stage: bool,
        records: wp.array[wp.float32],
        ids: wp.array[wp.int32],
        first: int,
        end: int,
        lane: int,
        j: int,
        part: int,
    ) -> wp.vec4: ...

    return read


@cache
def writer(length: int, lanes: int):
    """`write(sums, lane, rows, row)`: the sums of `length` numbers over 8 to 32 lanes, as a row of `rows`.

    Eight numbers are summed together: each of three exchanges halves how many a thread holds, then thread l
    has the l-th, summed over eight threads. For a warp that is 9 exchanges instead of 40. A lane that is 32
    or more takes part and writes nothing.
    """
    Sums = wp.types.vector(length=length, dtype=wp.float32)
    groups = [(start, min(8, length - start)) for start in range(0, length, 8)]
    pieces = []
    for start, size in groups:
        width = 1 << (size - 1).bit_length()
        values = ", ".join(f"sums[{start + i}]" if i < size else "0.0f" for i in range(width))
        pieces.append(f"""
    {{
        float v[{width}] = {{{values}}};
        #pragma unroll
        for (int half = {width // 2}; half >= 1; half /= 2) {{
            const bool upper = lane & half;
            #pragma unroll
            for (int i = 0; i < half; ++i) {{
                const float other = __shfl_xor_sync(0xffffffff, upper ? v[i] : v[i + half], half);
                v[i] = (upper ? v[i + half] : v[i]) + other;
            }}
        }}
        #pragma unroll
        for (int mask = {width}; mask < {lanes}; mask *= 2) v[0] += __shfl_xor_sync(0xffffffff, v[0], mask);
        if (lane < {size}) to[{start} + lane] = v[0];
    }}""")
    snippet = f"""
    float* to = rows.data + size_t(row) * {length};
#if defined(__CUDA_ARCH__){"".join(pieces)}
#else
    for (int i = 0; i < {length}; ++i) to[i] = sums[i];
#endif
"""

    @wp.func_native(snippet)
    def write(sums: Sums, lane: int, rows: wp.array2d[wp.float32], row: int): ...

    return write, Sums
