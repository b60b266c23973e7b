//! The processors that the program was built for.

/// Their name, as compilers and distributions know it.
pub(crate) const BUILT_FOR: &str = if cfg!(target_feature = "avx2") { "x86-64-v3" } else { std::env::consts::ARCH };

/// The message of a program for newer processors on an older one.
pub(crate) const TOO_OLD: &str = "error: this program is built for x86-64-v3, processors with AVX2 (since 2013), and \
    this processor is older; hint: the other package for x86-64 runs on all of them\n";

/// Returns whether this processor has the instructions that the program was built for, which it may use at any moment
/// after.
///
/// The source of the list is x86-64's psABI, section "Micro-Architecture Levels".
#[cfg(target_arch = "x86_64")]
#[inline(never)]
pub(crate) fn has_instructions() -> bool {
    use std::arch::x86_64::__cpuid;
    // The bits of FMA, MOVBE, OSXSAVE, AVX and F16C; of BMI1, AVX2 and BMI2; of LZCNT.
    const LEAF_1: u32 = 1 << 12 | 1 << 22 | 1 << 27 | 1 << 28 | 1 << 29;
    const LEAF_7: u32 = 1 << 3 | 1 << 5 | 1 << 8;
    const LEAF_EXTENDED_1: u32 = 1 << 5;
    if cfg!(not(target_feature = "avx2")) {
        return true;
    }
    // What a processor says of a leaf that it does not have means nothing.
    __cpuid(0).eax >= 7
        && __cpuid(1).ecx & LEAF_1 == LEAF_1
        && __cpuid(7).ebx & LEAF_7 == LEAF_7
        && __cpuid(0x8000_0001).ecx & LEAF_EXTENDED_1 == LEAF_EXTENDED_1
}

#[cfg(not(target_arch = "x86_64"))]
pub(crate) fn has_instructions() -> bool {
    true
}
