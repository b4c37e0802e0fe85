"""Files of other programs: LabVIEW's TDMS and LVM, Excel, MATLAB's -v7.3. Each is parsed apart.

Read `tdms_table.py` first; `parse_apart.py`, a folder above, calls it in a process of its own.
"""
