//! Numbers as few bits: adaptive models of sixteen symbols, coded by an asymmetric numeral system, beside bits as they
//! are.
//!
//! In: symbols with the models that expect them. Out: words. A model learns from every symbol alike in both
//! directions, so nothing of it is stored. Memory: 4 bytes a symbol while encoding.
//! Source: J. Duda, "Asymmetric numeral systems", 2013; what the models learn is F. Giesen's mix of distributions.

/// Probabilities are parts of `1 << PRECISION`.
const PRECISION: u32 = 15;
const TOTAL: i16 = i16::MAX;
/// Symbols of a model.
pub(super) const SYMBOLS: usize = 16;
/// Least part of a symbol, so that none is ever impossible.
const FLOOR: i16 = 8;
/// The state of the coder stays at or above it.
const LOW: u64 = 1 << 31;
/// How fast a model learns: by a part of `1 << rate` of what it is off, slower the more it has seen.
const FIRST_RATE: u32 = 3;
const LAST_RATE: u32 = 7;

/// Where a model would put the starts of its symbols if it knew that one is next, by symbol.
const KNOWN: [[i16; SYMBOLS]; SYMBOLS] = {
    let mut known = [[0; SYMBOLS]; SYMBOLS];
    let mut symbol = 0;
    while symbol < SYMBOLS {
        let mut i = 0;
        while i < SYMBOLS {
            let below = i as i16 * FLOOR;
            // `TOTAL` is one short of the whole, which has no i16.
            known[symbol][i] = if i <= symbol { below } else { TOTAL - (SYMBOLS as i16 - i as i16) * FLOOR + 1 };
            i += 1;
        }
        symbol += 1;
    }
    known
};

/// What is expected of a symbol.
#[derive(Debug, Clone)]
pub(super) struct SymbolModel {
    /// Sums of the parts of all symbols before each.
    starts: [i16; SYMBOLS],
    seen: u32,
}

impl SymbolModel {
    pub(super) const NEW: SymbolModel = {
        let mut starts = [0; SYMBOLS];
        let mut i = 0;
        while i < SYMBOLS {
            starts[i] = i as i16 * (1 << (PRECISION - 4));
            i += 1;
        }
        SymbolModel { starts, seen: 0 }
    };

    /// Start and part of a symbol.
    fn part(&self, symbol: usize) -> (u32, u32) {
        let start = self.starts[symbol] as u32;
        let end = self.starts.get(symbol + 1).map_or(1 << PRECISION, |&end| end as u32);
        (start, end - start)
    }

    /// Parts keep at least `FLOOR`: two starts move toward places that are so far apart, by the same share of the way.
    fn learn(&mut self, symbol: usize) {
        let rate = (FIRST_RATE + self.seen / 8).min(LAST_RATE);
        self.seen = self.seen.saturating_add(1);
        for (start, known) in self.starts.iter_mut().zip(&KNOWN[symbol]) {
            *start += (known - *start) >> rate;
        }
    }
}

/// Writes symbols and bits.
#[derive(Debug, Default)]
pub(super) struct SymbolEncoder {
    symbols: Vec<(u16, u16)>,
    bits: Vec<u8>,
    waiting: u64,
    waiting_bits: u32,
    /// Bits of what was written so far, about.
    cost: f64,
}

impl SymbolEncoder {
    /// Bits of what was written so far, about.
    pub(super) fn cost(&self) -> f64 {
        self.cost
    }

    pub(super) fn symbol(&mut self, model: &mut SymbolModel, symbol: usize) {
        let (start, part) = model.part(symbol);
        self.cost += f64::from(PRECISION) - f64::from(part).log2();
        self.symbols.push((start as u16, part as u16));
        model.learn(symbol);
    }

    /// The low `count` bits of `value`, at most 32.
    pub(super) fn bits(&mut self, value: u64, count: u32) {
        self.waiting |= (value & ((1 << count) - 1)) << self.waiting_bits;
        self.waiting_bits += count;
        self.cost += f64::from(count);
        while self.waiting_bits >= 8 {
            self.bits.push(self.waiting as u8);
            self.waiting >>= 8;
            self.waiting_bits -= 8;
        }
    }

    /// A number below 2^63 of whose magnitude nothing is known: of one more, how many bits follow the first, and these.
    pub(super) fn number(&mut self, value: u64) {
        let length = 64 - (value + 1).leading_zeros();
        self.bits(u64::from(length - 1), 6);
        self.long_bits(value + 1, length - 1);
    }

    /// The low `count` bits of `value`, at most 63.
    pub(super) fn long_bits(&mut self, value: u64, count: u32) {
        let low = count.min(32);
        self.bits(value, low);
        self.bits(value >> 32, count - low);
    }

    /// The words of the symbols with their length in front, and the bits.
    pub(super) fn finish(mut self) -> Vec<u8> {
        if self.waiting_bits > 0 {
            self.bits.push(self.waiting as u8);
        }
        // The last symbol goes in first: the decoder takes them from the top.
        let mut state = LOW;
        let mut words: Vec<u32> = Vec::new();
        for &(start, part) in self.symbols.iter().rev() {
            let (start, part) = (u64::from(start), u64::from(part));
            if state >= (LOW >> PRECISION << 32) * part {
                words.push(state as u32);
                state >>= 32;
            }
            state = ((state / part) << PRECISION) + state % part + start;
        }
        words.extend([state as u32, (state >> 32) as u32]);
        let mut out = Vec::with_capacity(8 + 4 * words.len() + self.bits.len());
        out.extend((4 * words.len() as u64).to_le_bytes());
        out.extend(words.iter().rev().flat_map(|word| word.to_le_bytes()));
        out.extend(self.bits);
        out
    }
}

/// Reads what [`SymbolEncoder`] wrote. Bytes that are no such thing give other symbols, and a [`SymbolDecoder::is_finished`] that is false.
#[derive(Debug)]
pub(super) struct SymbolDecoder<'a> {
    state: u64,
    words: std::slice::Iter<'a, [u8; 4]>,
    bits: &'a [u8],
    waiting: u64,
    waiting_bits: u32,
    is_short: bool,
}

impl<'a> SymbolDecoder<'a> {
    /// None where the lengths do not fit.
    pub(super) fn new(bytes: &'a [u8]) -> Option<SymbolDecoder<'a>> {
        let (length, rest) = bytes.split_first_chunk::<8>()?;
        let (words, bits) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
        let ([head, words @ ..], []) = words.as_chunks::<4>() else { return None };
        let (second, words) = words.split_first()?;
        let state = u64::from(u32::from_le_bytes(*head)) << 32 | u64::from(u32::from_le_bytes(*second));
        Some(SymbolDecoder { state, words: words.iter(), bits, waiting: 0, waiting_bits: 0, is_short: false })
    }

    #[inline(always)]
    pub(super) fn symbol(&mut self, model: &mut SymbolModel) -> usize {
        let place = (self.state & ((1 << PRECISION) - 1)) as i16;
        let at_or_below: i16 = model.starts.iter().map(|&start| i16::from(start <= place)).sum();
        let symbol = (at_or_below as usize - 1) & (SYMBOLS - 1);
        let (start, part) = model.part(symbol);
        self.state = u64::from(part) * (self.state >> PRECISION) + u64::from(place as u32 - start);
        if self.state < LOW {
            let word = self.words.next().map_or_else(
                || {
                    self.is_short = true;
                    0
                },
                |word| u32::from_le_bytes(*word),
            );
            self.state = self.state << 32 | u64::from(word);
        }
        model.learn(symbol);
        symbol
    }

    /// So many bits, at most 32.
    #[inline(always)]
    pub(super) fn bits(&mut self, count: u32) -> u64 {
        if self.waiting_bits < count {
            self.fill();
        }
        let value = self.waiting & ((1 << count) - 1);
        self.waiting >>= count;
        self.waiting_bits -= count;
        value
    }

    #[inline(never)]
    fn fill(&mut self) {
        while self.waiting_bits <= 56 {
            // Beyond the last one there are zeros: a checksum has seen all bytes before.
            let (&byte, rest) = self.bits.split_first().unwrap_or((&0, &[]));
            self.bits = rest;
            self.waiting |= u64::from(byte) << self.waiting_bits;
            self.waiting_bits += 8;
        }
    }

    pub(super) fn number(&mut self) -> u64 {
        let follow = self.bits(6) as u32;
        (1 << follow | self.long_bits(follow)) - 1
    }

    pub(super) fn long_bits(&mut self, count: u32) -> u64 {
        let low = count.min(32);
        let value = self.bits(low);
        value | self.bits(count - low) << 32
    }

    /// Whether everything was read, no more and no less.
    pub(super) fn is_finished(&self) -> bool {
        !self.is_short && self.state == LOW && self.words.len() == 0 && self.bits.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn symbols_and_bits_come_back_in_their_order(
            items in prop::collection::vec((0usize..SYMBOLS, 0usize..3, any::<u64>(), 0u32..64), 0..2000)
        ) {
            let mut models = vec![SymbolModel::NEW; 3];
            let mut encoder = SymbolEncoder::default();
            for &(symbol, model, value, count) in &items {
                encoder.symbol(&mut models[model], symbol);
                encoder.long_bits(value, count);
                encoder.number(value >> (count + 1).min(63));
            }
            let bytes = encoder.finish();
            let mut models = vec![SymbolModel::NEW; 3];
            let mut decoder = SymbolDecoder::new(&bytes).unwrap();
            for &(symbol, model, value, count) in &items {
                prop_assert_eq!(decoder.symbol(&mut models[model]), symbol);
                prop_assert_eq!(decoder.long_bits(count), value & ((1 << count) - 1));
                prop_assert_eq!(decoder.number(), value >> (count + 1).min(63));
            }
            prop_assert!(decoder.is_finished());
        }

        #[test]
        fn any_bytes_decode_to_something_without_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            if let Some(mut decoder) = SymbolDecoder::new(&bytes) {
                let mut model = SymbolModel::NEW;
                for _ in 0..300 {
                    prop_assert!(decoder.symbol(&mut model) < SYMBOLS);
                    decoder.number();
                }
            }
        }

        #[test]
        fn no_symbol_ever_becomes_impossible(symbols in prop::collection::vec(0usize..SYMBOLS, 0..5000)) {
            let mut model = SymbolModel::NEW;
            for symbol in symbols {
                model.learn(symbol);
                for of in 0..SYMBOLS {
                    prop_assert!(model.part(of).1 >= FLOOR as u32, "{:?}", model.starts);
                }
            }
        }
    }

    #[test]
    fn a_skewed_source_takes_its_entropy() {
        // Three quarters of one symbol, the rest even over three others: H = 0.75·log2(4/3) + 0.25·log2(12) = 1.2075.
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
