//! Entropy coder for symbols from 0 to 15. Adaptive models predict the symbols, and an asymmetric numeral system (ANS)
//! codes them. Plain bits are stored in a stream beside the symbols.
//!
//! Input: symbols, each with the model that predicts it. Output: bytes. Encoder and decoder update the models alike, so
//! models are not stored. Memory: 4 bytes per symbol while encoding. Source: J. Duda, "Asymmetric numeral systems",
//! 2013; models are updated by F. Giesen's mixing of distributions.

/// Number of bits of a probability: probabilities are multiples of 1/2^15.
const PRECISION: u32 = 15;
/// Upper end of the cumulative probabilities of a model, in units of 1/2^15. It is one less than their sum 2^15, which
/// does not fit into i16.
const TOTAL: i16 = i16::MAX;
/// Number of different symbols that a model predicts.
pub(super) const SYMBOLS: usize = 16;
/// Minimum probability of a symbol, in units of 1/2^15. It keeps every symbol possible.
const MIN_PROBABILITY: i16 = 8;
/// Minimum probability of a bit that is coded with a model, in units of 1/2^15.
const MIN_BIT_PROBABILITY: i32 = 64;
/// Lower bound of the 64-bit state of the ANS coder; when the state is below it, the decoder reads another 32-bit word.
const MIN_STATE: u64 = 1 << 31;
/// Initial value of `rate`, a number that sets how fast a model learns. After each symbol, the model's probabilities
/// move toward those of a model that is certain of this symbol, by the fraction 1/2^`rate` of the difference. `rate`
/// grows by one every 8 symbols, so that the model changes more and more slowly.
const FIRST_RATE: u32 = 3;
/// Largest value of `rate` (see [`FIRST_RATE`]): a model that has seen many symbols still moves its probabilities by
/// 1/2^7 of the difference after each symbol.
const LAST_RATE: u32 = 7;

/// For each symbol: cumulative probabilities, in units of 1/2^15, of a model that is certain of this symbol. Such a
/// model gives every other symbol the probability [`MIN_PROBABILITY`].
const CERTAIN_STARTS: [[i16; SYMBOLS]; SYMBOLS] = {
    let mut known = [[0; SYMBOLS]; SYMBOLS];
    let mut symbol = 0;
    while symbol < SYMBOLS {
        let mut i = 0;
        while i < SYMBOLS {
            let below = i as i16 * MIN_PROBABILITY;
            // `TOTAL` is one less than the sum, which does not fit into i16.
            known[symbol][i] =
                if i <= symbol { below } else { TOTAL - (SYMBOLS as i16 - i as i16) * MIN_PROBABILITY + 1 };
            i += 1;
        }
        symbol += 1;
    }
    known
};

/// Adaptive probabilities of the symbols 0 to 15.
#[derive(Debug, Clone)]
pub(super) struct SymbolModel {
    /// For each symbol, the sum of the probabilities of all lower symbols, in units of 1/2^15.
    starts: [i16; SYMBOLS],
    /// Number of symbols that the model has seen so far; it determines the learning rate.
    seen: u32,
}

impl SymbolModel {
    /// Model that has seen no symbol: all symbols are equally likely.
    pub(super) const NEW: SymbolModel = {
        let mut starts = [0; SYMBOLS];
        let mut i = 0;
        while i < SYMBOLS {
            starts[i] = i as i16 * (1 << (PRECISION - 4));
            i += 1;
        }
        SymbolModel { starts, seen: 0 }
    };

    /// Returns the interval of `symbol`, in units of 1/2^15: its start, which is the sum of the probabilities of all
    /// lower symbols, and its length, which is the probability of `symbol`.
    fn interval(&self, symbol: usize) -> (u32, u32) {
        let start = self.starts[symbol] as u32;
        let end = self.starts.get(symbol + 1).map_or(1 << PRECISION, |&end| end as u32);
        (start, end - start)
    }

    /// Updates the model after `symbol` was coded: moves the probabilities toward those of a model that is certain of
    /// `symbol`. Every probability stays at least `MIN_PROBABILITY`, because it is at least that large before the
    /// update and in the certain model.
    fn learn(&mut self, symbol: usize) {
        let rate = (FIRST_RATE + self.seen / 8).min(LAST_RATE);
        self.seen = self.seen.saturating_add(1);
        for (start, known) in self.starts.iter_mut().zip(&CERTAIN_STARTS[symbol]) {
            *start += (known - *start) >> rate;
        }
    }
}

/// Adaptive probability of a bit.
#[derive(Debug, Clone)]
pub(super) struct BitModel {
    /// Probability that the bit is 0, in units of 1/2^15.
    zero: i32,
    /// Number of bits that the model has seen so far; it determines the learning rate.
    seen: u32,
}

impl BitModel {
    /// Model that has seen no bit: 0 and 1 are equally likely.
    pub(super) const NEW: BitModel = BitModel { zero: 1 << (PRECISION - 1), seen: 0 };

    /// Returns the probability interval of `bit`, in units of 1/2^15: its start, and its length, which is the
    /// probability of `bit`.
    fn interval(&self, bit: bool) -> (u32, u32) {
        let zero = self.zero as u32;
        if bit { (zero, (1 << PRECISION) - zero) } else { (0, zero) }
    }

    /// Updates the model after `bit` was coded: raises the probability of `bit`. The probabilities of 0 and of 1 both
    /// stay at least [`MIN_BIT_PROBABILITY`].
    fn learn(&mut self, bit: bool) {
        let rate = (FIRST_RATE + self.seen / 8).min(LAST_RATE);
        self.seen = self.seen.saturating_add(1);
        let known = if bit { MIN_BIT_PROBABILITY } else { (1 << PRECISION) - MIN_BIT_PROBABILITY };
        self.zero += (known - self.zero) >> rate;
    }
}

/// Writer of entropy-coded symbols and plain bits.
#[derive(Debug, Default)]
pub(super) struct SymbolEncoder {
    symbols: Vec<(u16, u16)>,
    bits: Vec<u8>,
    pending: u64,
    pending_bits: u32,
    /// Approximate number of bits written so far, for symbols and plain bits together.
    cost: f64,
}

impl SymbolEncoder {
    /// Returns the approximate number of bits written so far, for symbols and plain bits together.
    pub(super) fn cost(&self) -> f64 {
        self.cost
    }

    /// Writes `symbol`, coded with the probability that `model` gives it. Then updates the model.
    pub(super) fn symbol(&mut self, model: &mut SymbolModel, symbol: usize) {
        self.interval(model.interval(symbol));
        model.learn(symbol);
    }

    /// Writes `bit`, coded with the probability that `model` gives it. Then updates the model.
    pub(super) fn bit(&mut self, model: &mut BitModel, bit: bool) {
        self.interval(model.interval(bit));
        model.learn(bit);
    }

    /// Writes the symbol that has the given probability interval (start and length), in units of 1/2^15.
    fn interval(&mut self, (start, length): (u32, u32)) {
        self.cost += f64::from(PRECISION) - f64::from(length).log2();
        self.symbols.push((start as u16, length as u16));
    }

    /// Writes the low `count` (at most 32) bits of `value` as plain bits.
    pub(super) fn bits(&mut self, value: u64, count: u32) {
        self.pending |= (value & ((1 << count) - 1)) << self.pending_bits;
        self.pending_bits += count;
        self.cost += f64::from(count);
        while self.pending_bits >= 8 {
            self.bits.push(self.pending as u8);
            self.pending >>= 8;
            self.pending_bits -= 8;
        }
    }

    /// Writes a number below 2^63 of unknown magnitude: first the index of the highest set bit of `value + 1`, in 6
    /// bits, then the bits of `value + 1` below it.
    pub(super) fn number(&mut self, value: u64) {
        let length = 64 - (value + 1).leading_zeros();
        self.bits(u64::from(length - 1), 6);
        self.long_bits(value + 1, length - 1);
    }

    /// Writes the low `count` (at most 63) bits of `value` as plain bits.
    pub(super) fn long_bits(&mut self, value: u64, count: u32) {
        let low = count.min(32);
        self.bits(value, low);
        self.bits(value >> 32, count - low);
    }

    /// Returns the encoded bytes: a u64 with the total length in bytes of the ANS coder's 32-bit words, these words,
    /// and the plain bits.
    pub(super) fn finish(mut self) -> Vec<u8> {
        if self.pending_bits > 0 {
            self.bits.push(self.pending as u8);
        }
        // ANS is last in, first out: encoding in reverse lets the decoder read symbols in order.
        let mut state = MIN_STATE;
        let mut words: Vec<u32> = Vec::new();
        for &(start, interval) in self.symbols.iter().rev() {
            let (start, interval) = (u64::from(start), u64::from(interval));
            if state >= (MIN_STATE >> PRECISION << 32) * interval {
                words.push(state as u32);
                state >>= 32;
            }
            state = ((state / interval) << PRECISION) + state % interval + start;
        }
        words.extend([state as u32, (state >> 32) as u32]);
        let mut out = Vec::with_capacity(8 + 4 * words.len() + self.bits.len());
        out.extend((4 * words.len() as u64).to_le_bytes());
        out.extend(words.iter().rev().flat_map(|word| word.to_le_bytes()));
        out.extend(self.bits);
        out
    }
}

/// Decoder of the bytes written by [`SymbolEncoder`]. If the bytes are damaged, it returns arbitrary symbols, and
/// [`SymbolDecoder::is_finished`] returns false at the end.
#[derive(Debug)]
pub(super) struct SymbolDecoder<'a> {
    state: u64,
    words: std::slice::Iter<'a, [u8; 4]>,
    bits: &'a [u8],
    pending: u64,
    pending_bits: u32,
    /// Whether the decoder has needed more 32-bit words than the input has.
    is_short: bool,
}

impl<'a> SymbolDecoder<'a> {
    /// Returns a decoder of `bytes`. Returns `None` if the stored length of the ANS coder's 32-bit words exceeds
    /// `bytes` or is not a multiple of 4, or if there are fewer than two of these words.
    pub(super) fn new(bytes: &'a [u8]) -> Option<SymbolDecoder<'a>> {
        let (length, rest) = bytes.split_first_chunk::<8>()?;
        let (words, bits) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
        let ([head, words @ ..], []) = words.as_chunks::<4>() else { return None };
        let (second, words) = words.split_first()?;
        let state = u64::from(u32::from_le_bytes(*head)) << 32 | u64::from(u32::from_le_bytes(*second));
        Some(SymbolDecoder { state, words: words.iter(), bits, pending: 0, pending_bits: 0, is_short: false })
    }

    /// Reads the next symbol, which is coded with the probabilities of `model`. Then updates the model.
    #[inline(always)]
    pub(super) fn symbol(&mut self, model: &mut SymbolModel) -> usize {
        let place = (self.state & ((1 << PRECISION) - 1)) as i16;
        let at_or_below: i16 = model.starts.iter().map(|&start| i16::from(start <= place)).sum();
        let symbol = (at_or_below as usize - 1) & (SYMBOLS - 1);
        self.advance(place as u32, model.interval(symbol));
        model.learn(symbol);
        symbol
    }

    /// Reads the next bit, which is coded with the probability of `model`. Then updates the model.
    #[inline(always)]
    pub(super) fn bit(&mut self, model: &mut BitModel) -> bool {
        let place = (self.state & ((1 << PRECISION) - 1)) as u32;
        let bit = place >= model.zero as u32;
        self.advance(place, model.interval(bit));
        model.learn(bit);
        bit
    }

    /// Advances the decoder after one symbol: removes the symbol from the state of the ANS coder, and reads a 32-bit
    /// word of the input if the state is then below [`MIN_STATE`]. `place`: low 15 bits of the state, by which the
    /// symbol was found. `(start, length)`: probability interval of the symbol, in units of 1/2^15; it contains
    /// `place`.
    #[inline(always)]
    fn advance(&mut self, place: u32, (start, length): (u32, u32)) {
        self.state = u64::from(length) * (self.state >> PRECISION) + u64::from(place - start);
        if self.state < MIN_STATE {
            let word = self.words.next().map_or_else(
                || {
                    self.is_short = true;
                    0
                },
                |word| u32::from_le_bytes(*word),
            );
            self.state = self.state << 32 | u64::from(word);
        }
    }

    /// Reads `count` (at most 32) plain bits.
    #[inline(always)]
    pub(super) fn bits(&mut self, count: u32) -> u64 {
        if self.pending_bits < count {
            self.fill();
        }
        let value = self.pending & ((1 << count) - 1);
        self.pending >>= count;
        self.pending_bits -= count;
        value
    }

    /// Moves bytes from the input to the 64-bit buffer of plain bits, until less than one byte of the buffer is free.
    #[inline(never)]
    fn fill(&mut self) {
        while self.pending_bits <= 56 {
            // Zeros follow the last byte; a checksum has verified that all bytes are present.
            let (&byte, rest) = self.bits.split_first().unwrap_or((&0, &[]));
            self.bits = rest;
            self.pending |= u64::from(byte) << self.pending_bits;
            self.pending_bits += 8;
        }
    }

    /// Reads a number below 2^63 that [`SymbolEncoder::number`] wrote.
    pub(super) fn number(&mut self) -> u64 {
        let follow = self.bits(6) as u32;
        (1 << follow | self.long_bits(follow)) - 1
    }

    /// Reads `count` (at most 63) plain bits.
    pub(super) fn long_bits(&mut self, count: u32) -> u64 {
        let low = count.min(32);
        let value = self.bits(low);
        value | self.bits(count - low) << 32
    }

    /// Returns whether the decoder has read the input exactly: no symbol and no byte is left, and no symbol was read
    /// beyond the end.
    pub(super) fn is_finished(&self) -> bool {
        !self.is_short && self.state == MIN_STATE && self.words.len() == 0 && self.bits.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn symbols_and_bits_are_read_back_in_order(
            items in prop::collection::vec((0usize..SYMBOLS, 0usize..3, any::<u64>(), 0u32..64), 0..2000)
        ) {
            let (mut models, mut signs) = (vec![SymbolModel::NEW; 3], vec![BitModel::NEW; 3]);
            let mut encoder = SymbolEncoder::default();
            for &(symbol, model, value, count) in &items {
                encoder.symbol(&mut models[model], symbol);
                encoder.bit(&mut signs[model], value & 5 == 0);
                encoder.long_bits(value, count);
                encoder.number(value >> (count + 1).min(63));
            }
            let bytes = encoder.finish();
            let (mut models, mut signs) = (vec![SymbolModel::NEW; 3], vec![BitModel::NEW; 3]);
            let mut decoder = SymbolDecoder::new(&bytes).unwrap();
            for &(symbol, model, value, count) in &items {
                prop_assert_eq!(decoder.symbol(&mut models[model]), symbol);
                prop_assert_eq!(decoder.bit(&mut signs[model]), value & 5 == 0);
                prop_assert_eq!(decoder.long_bits(count), value & ((1 << count) - 1));
                prop_assert_eq!(decoder.number(), value >> (count + 1).min(63));
            }
            prop_assert!(decoder.is_finished());
        }

        #[test]
        fn decoding_any_bytes_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            if let Some(mut decoder) = SymbolDecoder::new(&bytes) {
                let (mut model, mut sign) = (SymbolModel::NEW, BitModel::NEW);
                for _ in 0..300 {
                    prop_assert!(decoder.symbol(&mut model) < SYMBOLS);
                    decoder.bit(&mut sign);
                    decoder.number();
                }
            }
        }

        #[test]
        fn no_symbol_ever_becomes_impossible(symbols in prop::collection::vec(0usize..SYMBOLS, 0..5000)) {
            let mut model = SymbolModel::NEW;
            for symbol in symbols {
                model.learn(symbol);
                for other in 0..SYMBOLS {
                    prop_assert!(model.interval(other).1 >= MIN_PROBABILITY as u32, "{:?}", model.starts);
                }
            }
        }
    }

    #[test]
    fn no_bit_ever_becomes_impossible() {
        for bit in [false, true] {
            let mut model = BitModel::NEW;
            (0..10_000).for_each(|_| model.learn(bit));
            assert!(model.interval(!bit).1 >= MIN_BIT_PROBABILITY as u32, "{model:?}");
        }
    }

    #[test]
    fn a_skewed_source_needs_about_its_entropy() {
        // Three quarters are one symbol, the rest is spread evenly over three others: H = 0.75·log2(4/3) +
        // 0.25·log2(12) = 1.2075.
        let mut encoder = SymbolEncoder::default();
        let mut model = SymbolModel::NEW;
        let mut random = 1u64;
        let count = 40_000;
        for _ in 0..count {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let symbol = match random >> 60 {
                0..12 => 5,
                _ => 1 + 3 * ((random >> 40) % 3) as usize,
            };
            encoder.symbol(&mut model, symbol);
        }
        let bits = 8.0 * encoder.finish().len() as f64 / f64::from(count);
        assert!(bits < 1.25 && bits > 1.19, "{bits} bits a symbol");
    }
}
