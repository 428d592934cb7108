"""FITS files written by hand: they may claim anything."""

TWO_BY_THREE = {"BITPIX": -64, "NAXIS": 2, "NAXIS1": 3, "NAXIS2": 2}
"""An image of zeros; a keyword of value None is left out."""


def fits_bytes(keywords):
    """Return a file of one part: these keywords, a comment, and a block of zeros."""
    cards = [f"{k:8}= {v:>20}" for k, v in keywords.items() if v is not None]
    head = "".join(card.ljust(80) for card in ["SIMPLE  =                    T", *cards])
    head += "COMMENT".ljust(80) + "END".ljust(80)
    return head.encode().ljust(-(-len(head) // 2880) * 2880) + bytes(2880)
