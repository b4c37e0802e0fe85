"""Files of other programs: LabVIEW's TDMS and LVM, Excel, MATLAB's -v7.3. Each is parsed apart.

Read `pamctl.log.importing.parse_apart` first, then any of these: each returns a `MeasuredTable`.
"""
