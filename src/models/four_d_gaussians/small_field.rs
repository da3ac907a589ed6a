//! Compact form of the state dict of a deformation field: half precision, constant tensors stored as one value, and
//! only those rows of time planes (feature planes over time) that are read.
//!
//! Input: the tensors of a state dict. Output: tensors of the same names and shapes, as a file stores them; the loader
//! of the original code copies them into its own single-precision parameters. Memory: one copy of the tensors.

use half::f16;
use half::slice::HalfFloatSliceExt;
use half::vec::HalfFloatVecExt;

use crate::deform::{Tensor, Tensors, count_unread_time_rows};
use crate::files::state_dict::{MAX_EXPANSION, StoredTensor, TensorValues};

/// Minimum number of values of a tensor that is stored in half precision. Smaller tensors (biases, the last layers of
/// heads, the bounding box of the field) take few bytes, and every value of the field depends on them.
const MIN_HALF_VALUES: usize = 1024;
/// Maximum root mean square error of a tensor in half precision, as a fraction of the root mean square of the tensor.
/// The rounding of values within the range of half precision stays below it. Values that are too large or too small for
/// half precision exceed it.
const MAX_ERROR: f64 = 1.0 / 2048.0;

/// Returns `tensors` with the values that are read back after storage in half precision. Tensors that are not stored in
/// half precision (small ones, and values out of its range) are unchanged.
pub(super) fn rounded(mut tensors: Tensors) -> Tensors {
    for tensor in tensors.values_mut() {
        if let Some(halves) = halves(tensor) {
            tensor.data = halves.to_f32_vec();
        }
    }
    tensors
}

/// Returns the tensors of a deformation field in compact form. `from_zero` states that the field is never read at times
/// below 0. Then the rows of time planes (feature planes over time) for these times are never read either, and they
/// share the storage of other rows.
pub(super) fn stored(tensors: &Tensors, from_zero: bool) -> Vec<StoredTensor> {
    let pack = |shares: bool| -> Vec<StoredTensor> {
        let pack = |(name, tensor): (&String, &Tensor)| match shares {
            true => packed(name, tensor, from_zero),
            false => StoredTensor::dense(name.clone(), tensor.shape.clone(), values(tensor, &tensor.data)),
        };
        tensors.iter().map(pack).collect()
    };
    let small = pack(true);
    let bytes = |values: usize, tensor: &StoredTensor| (values * tensor.values.width()) as u64;
    let stored_bytes: u64 = small.iter().map(|tensor| bytes(tensor.values.len(), tensor)).sum();
    let expanded_bytes: u64 = small.iter().map(|tensor| bytes(tensor.shape.iter().product(), tensor)).sum();
    // Readers limit the ratio of expanded to stored bytes; if it would be exceeded, all tensors are written in full.
    if expanded_bytes > MAX_EXPANSION * stored_bytes { pack(false) } else { small }
}

/// Returns the compact form of the tensor called `name`. `from_zero` states that the field is never read at times below
/// 0. Rows of time planes (feature planes over time) for these times then get no storage of their own.
fn packed(name: &str, tensor: &Tensor, from_zero: bool) -> StoredTensor {
    let is_first = |value: &f32| value.to_bits() == tensor.data[0].to_bits();
    if tensor.data.len() > 1 && tensor.data.iter().all(is_first) {
        let dense = StoredTensor::dense(name.to_owned(), tensor.shape.clone(), values(tensor, &tensor.data[..1]));
        return StoredTensor { stride: vec![0; tensor.shape.len()], ..dense };
    }
    let dense = |data| StoredTensor::dense(name.to_owned(), tensor.shape.clone(), values(tensor, data));
    let unread = if from_zero { count_unread_time_rows(name, &tensor.shape) } else { 0 };
    let &[_, _, rows, columns] = &tensor.shape[..] else { return dense(&tensor.data) };
    if unread == 0 {
        return dense(&tensor.data);
    }
    // The unread first rows of each channel share storage with the last rows of the channel before. The first channel
    // has unread rows of its own.
    let mut data = tensor.data[..unread * columns].to_vec();
    for channel in tensor.data.chunks_exact(rows * columns) {
        data.extend(&channel[unread * columns..]);
    }
    let mut stored = dense(&data);
    stored.stride[1] = (rows - unread) * columns;
    stored.stride[0] = data.len();
    stored
}

/// Returns `data`, some of the values of `tensor`, in the precision (half or single) in which `tensor` is stored.
fn values(tensor: &Tensor, data: &[f32]) -> TensorValues {
    match halves(tensor) {
        Some(_) => TensorValues::F16(Vec::from_f32_slice(data)),
        None => TensorValues::F32(data.to_vec()),
    }
}

/// Returns the tensor in half precision; `None` if it has fewer than [`MIN_HALF_VALUES`] values or its error would
/// exceed [`MAX_ERROR`].
fn halves(tensor: &Tensor) -> Option<Vec<f16>> {
    let halves = Vec::<f16>::from_f32_slice(&tensor.data);
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>();
    let error = square(&mut tensor.data.iter().zip(&halves).map(|(x, half)| f64::from(*x) - half.to_f64()));
    let all = square(&mut tensor.data.iter().map(|&x| f64::from(x)));
    // The comparison is false for values that are not finite.
    (halves.len() >= MIN_HALF_VALUES && error <= MAX_ERROR.powi(2) * all).then_some(halves)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a tensor of the shape `shape` with distinct values between −`scale`/2 and `scale`/2.
    fn tensor(shape: &[usize], scale: f32) -> Tensor {
        let count: usize = shape.iter().product();
        let data = (0..count).map(|i| scale * ((i as f32 * 0.618_034).fract() - 0.5)).collect();
        Tensor { shape: shape.to_vec(), data }
    }

    /// Returns the tensor `stored` with all its elements, each read at the index that its strides give.
    fn read(stored: &StoredTensor) -> Tensor {
        let mut data = vec![stored.offset];
        for (&extent, &stride) in stored.shape.iter().zip(&stored.stride) {
            data = data.into_iter().flat_map(|at| (0..extent).map(move |i| at + i * stride)).collect();
        }
        let value = |at: usize| match &stored.values {
            TensorValues::F32(values) => values[at],
            TensorValues::F16(values) => values[at].to_f32(),
        };
        Tensor { shape: stored.shape.clone(), data: data.into_iter().map(value).collect() }
    }

    /// Name of a time plane (feature plane over a spatial axis and time).
    const TIME: &str = "deformation_net.grid.grids.1.4";

    #[test]
    fn unread_time_rows_take_no_bytes() {
        for rows in [1, 2, 25, 50] {
            let plane = tensor(&[1, 16, rows, 8], 1.0);
            let tensors = Tensors::from([(TIME.to_owned(), plane.clone())]);
            let unread = count_unread_time_rows(TIME, &plane.shape);
            assert_eq!(unread, (rows - 1) / 2);
            let [small, whole] = [true, false].map(|from_zero| stored(&tensors, from_zero).remove(0));
            assert_eq!(whole.values.len(), plane.data.len());
            assert_eq!(small.values.len(), plane.data.len() - 15 * unread * 8);
            let expected = &rounded(tensors)[TIME].data;
            assert_eq!(&read(&whole).data, expected);
            let found = read(&small).data;
            for (k, (found, expected)) in found.iter().zip(expected).enumerate() {
                assert!(found == expected || k / 8 % rows < unread, "row {} of {rows}", k / 8 % rows);
            }
        }
        assert_eq!(count_unread_time_rows("deformation_net.grid.grids.1.3", &[1, 16, 50, 8]), 0);
        assert_eq!(count_unread_time_rows(TIME, &[16, 50, 8]), 0);
    }

    #[test]
    fn small_or_unrepresentable_tensors_stay_exact() {
        let few = tensor(&[MIN_HALF_VALUES - 1], 1.0);
        let mut large = tensor(&[64, 32], 1.0);
        large.data[77] = 65_520.0;
        let mut odd = tensor(&[64, 32], 1.0);
        odd.data[5] = f32::NAN;
        let tiny = tensor(&[64, 32], 1e-6);
        let fits = tensor(&[64, 32], 1.0);
        let mut almost_all = tensor(&[64, 32], 1.0);
        almost_all.data[9] = 1e-7;
        for (what, tensor, halved) in [
            ("few", few, false),
            ("large", large, false),
            ("odd", odd, false),
            ("tiny", tiny, false),
            ("fits", fits, true),
            ("one that is tiny", almost_all, true),
        ] {
            let stored = packed(what, &tensor, true);
            assert_eq!(matches!(stored.values, TensorValues::F16(_)), halved, "{what}");
            let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect::<Vec<u32>>();
            if !halved {
                assert_eq!(bits(&read(&stored).data), bits(&tensor.data), "{what}");
            }
        }
    }

    #[test]
    fn constant_tensor_is_stored_once_within_the_limit() {
        let constant = Tensor { shape: vec![40, 50], data: vec![0.1; 2000] };
        let zeros = |sign: f32| Tensor { shape: vec![2], data: vec![0.0, sign * 0.0] };
        let tensors = |more: usize| {
            let more = ("weight".to_owned(), tensor(&[more], 1.0));
            Tensors::from([("constant".to_owned(), constant.clone()), more])
        };
        assert_eq!(packed("b", &zeros(1.0), true).values.len(), 1);
        assert_eq!(packed("b", &zeros(-1.0), true).values.len(), 2, "the sign of a zero is a value");
        let small = stored(&tensors(2000), true);
        assert_eq!((small[0].values.len(), &small[0].stride), (1, &vec![0, 0]));
        assert_eq!(read(&small[0]), rounded(tensors(2000))["constant"]);
        let whole = stored(&tensors(10), true);
        assert_eq!(whole[0].values.len(), 2000);
        assert_eq!(read(&whole[0]), rounded(tensors(10))["constant"]);
    }

    #[test]
    fn rounding_twice_equals_rounding_once() {
        let tensors = Tensors::from([("a".to_owned(), tensor(&[80, 90], 3.0)), ("b".to_owned(), tensor(&[9], 3.0))]);
        let once = rounded(tensors);
        assert_eq!(rounded(once.clone()), once);
    }
}
